#pragma once
// What the disk cache's tests share: tiles that tell from their own bytes whether they are right, and a scratch directory.

#include <gtest/gtest.h>

#include <algorithm>
#include <filesystem>
#include <memory>
#include <random>
#include <string>

#include "storage/cache/disk_cache.h"

namespace lodestone {

inline CacheKey disk_key(std::uint64_t number) { return {number * 0x9E3779B97F4A7C15u ^ number >> 7, number * 0xD6E8FEB86659FD93u + 1}; }

// Every byte follows from the number. Mostly a few KiB; some are tiny, some large, some just at a page's edge.
inline std::size_t disk_tile_bytes(std::uint64_t number) {
  switch (number % 7) {
    case 0: return number % 1999;
    case 1: return 4064;
    case 2: return 1900 + number % 200;
    case 3: return 20000 + number % 30000;
    default: return 3000 + number % 4000;
  }
}
inline CachedTilePtr disk_tile(std::uint64_t number) {
  auto tile = std::make_shared<CachedTile>();
  tile->body.resize(disk_tile_bytes(number));
  std::uint64_t state = number * 0xD1342543DE82EF95u + 7;
  for (std::size_t i = 0; i < tile->body.size(); i += 8) {
    state = state * 6364136223846793005u + 1442695040888963407u;
    const std::uint64_t word = state ^ state >> 29;
    for (std::size_t j = i; j < std::min(i + 8, tile->body.size()); ++j) tile->body[j] = static_cast<char>(word >> 8 * (j - i));
  }
  tile->max_error_m = static_cast<float>(number % 1000) / 8;
  tile->provenance = number % 8;
  return tile;
}
inline bool is_disk_tile(const CachedTile& tile, std::uint64_t number) {
  const CachedTilePtr wanted = disk_tile(number);
  return tile.body == wanted->body && tile.max_error_m == wanted->max_error_m && tile.provenance == wanted->provenance;
}

class DiskCacheTest : public ::testing::Test {
 protected:
  DiskCacheTest() {
    std::string name = (std::filesystem::temp_directory_path() / "lodestone-cache-XXXXXX").string();
    if (!::mkdtemp(name.data())) throw std::runtime_error("no scratch directory");
    root_ = name;
  }
  ~DiskCacheTest() override {
    std::error_code ignored;
    std::filesystem::remove_all(root_, ignored);
  }

  std::filesystem::path directory() const { return root_ / "cache"; }
  std::filesystem::path data_file() const { return directory() / "data.mdb"; }
  DiskCacheOptions options(std::uint64_t budget_bytes = 8 << 20) const {
    DiskCacheOptions options;
    options.directory = directory();
    options.budget_bytes = budget_bytes;
    options.kernel_hash = 77;
    return options;
  }
  static void fill(DiskCache& cache, std::uint64_t first, std::uint64_t count, const std::string& tag = "layer/recipe") {
    for (std::uint64_t i = 0; i < count; ++i) cache.put(disk_key(first + i), tag, disk_tile(first + i));
    cache.flush();
  }
  // How many are there; a wrong byte is a failure.
  static std::uint64_t count_right(DiskCache& cache, std::uint64_t first, std::uint64_t count) {
    std::uint64_t right = 0;
    for (std::uint64_t i = first; i < first + count; ++i) {
      const CachedTilePtr tile = cache.get(disk_key(i));
      if (!tile) continue;
      if (is_disk_tile(*tile, i)) {
        ++right;
      } else {
        ADD_FAILURE() << "wrong bytes for tile " << i;
      }
    }
    return right;
  }

  std::filesystem::path root_;
};

}  // namespace lodestone
