#pragma once
// TileReader: decoded tiles of one LMDB environment through a sharded LRU, and windows assembled from them.

#include <array>
#include <atomic>
#include <cstdint>
#include <list>
#include <map>
#include <memory>
#include <mutex>
#include <optional>

#include "kernels/types/height_grid.h"
#include "kernels/types/result.h"
#include "storage/dem/layer_info.h"
#include "storage/dem/lmdb_env.h"
#include "storage/dem/tile_codec.h"

namespace lodestone {

// Posts that the stored tile `id` holds: its window, cut to the level's data.
PostWindow stored_window(const LayerInfo& layer, const TileId& id);
inline PostWindow intersection(const PostWindow& a, const PostWindow& b) {
  return {std::max(a.i0, b.i0), std::max(a.j0, b.j0), std::min(a.i1, b.i1), std::min(a.j1, b.j1)};
}

// Thread-safe.
class TileReader {
 public:
  // layer: grid and levels only; its statistics are not read.
  TileReader(std::shared_ptr<const LmdbEnv> env, const LayerInfo& layer, std::size_t decoded_bytes)
      : env_(std::move(env)), layer_(layer), shard_bytes_(decoded_bytes / kShards) {}

  // Errors: kNotFound (no such tile stored), kCorrupt (names tile and file), kIo.
  Result<std::shared_ptr<const HeightGrid>> tile(const TileId& id) const;
  Result<VoidMode> void_mode(const TileId& id) const;
  // `window` must lie inside world_at(level), 0 <= level <= base level.
  Result<HeightGrid> window(int level, const PostWindow& window) const;
  std::uint64_t corrupt_values() const { return corrupt_values_.load(std::memory_order_relaxed); }

 private:
  using TilePtr = std::shared_ptr<const HeightGrid>;
  using Lru = std::list<std::pair<TileId, TilePtr>>;
  struct Shard {
    std::mutex mutex;  // guards all below
    Lru recent_first;
    std::map<TileId, Lru::iterator> by_id;
    std::size_t bytes = 0;
  };
  static constexpr std::size_t kShards = 16;
  Error failed(Error error, const TileId& id) const;

  const std::shared_ptr<const LmdbEnv> env_;
  const LayerInfo layer_;
  const std::size_t shard_bytes_;
  mutable std::array<Shard, kShards> shards_;
  mutable std::atomic<std::uint64_t> corrupt_values_{0};
};

}  // namespace lodestone
