#pragma once
// MemoryCache: finished tiles in memory, bounded in bytes, scan-resistant (S3-FIFO: small, main and ghost queues), sharded.

#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>

namespace lodestone {

// A finished response body and what its headers need. Immutable once made.
struct CachedTile {
  std::string body;
  float max_error_m = 0;      // Lodestone-Max-Error-M
  std::uint8_t provenance = 0;  // bit 0 surveyed, bit 1 filled, bit 2 synthetic
  std::size_t charged_bytes() const { return body.size() + sizeof(CachedTile) + 64; }
};
using CachedTilePtr = std::shared_ptr<const CachedTile>;

// 128-bit hash of the whole TileKey text.
struct CacheKey {
  std::uint64_t hi = 0, lo = 0;
  bool operator==(const CacheKey&) const = default;
};

// Thread-safe.
class MemoryCache {
 public:
  struct Stats {
    std::uint64_t hits = 0, misses = 0, inserts = 0, evictions = 0;
    std::size_t bytes = 0, entries = 0;
  };
  static std::unique_ptr<MemoryCache> create(std::size_t budget_bytes);  // 0: caches nothing
  virtual ~MemoryCache() = default;
  virtual CachedTilePtr get(const CacheKey& key) = 0;
  virtual void put(const CacheKey& key, CachedTilePtr tile) = 0;  // larger than a shard's budget: not kept
  virtual void clear() = 0;
  virtual Stats stats() const = 0;
};

}  // namespace lodestone
