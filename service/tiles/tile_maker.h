#pragma once
// TileMaker: finished tiles from their keys: ground, quantum, encoding. One object per worker thread.

#include <memory>
#include <span>
#include <vector>

#include "kernels/types/result.h"
#include "service/ground/ground_maker.h"
#include "service/tiles/tile_key.h"
#include "storage/cache/memory_cache.h"

namespace lodestone {

class TileMaker {
 public:
  explicit TileMaker(std::unique_ptr<GroundMaker> ground) : ground_(std::move(ground)) {}

  struct Made {
    CachedTilePtr tile;
    double ground_ms = 0;  // reading, synthesis: the tile's share of its batch
    double encode_ms = 0;
  };
  // One result per key, in their order; each fails alone. Errors: those of GroundMaker::make and of the encoders.
  std::vector<Result<Made>> make(std::span<const TileKey> keys);

  GroundMaker& ground() { return *ground_; }

 private:
  Result<Made> encode(const TileKey& key, Ground& ground);
  Result<Made> flat(const TileKey& key);  // mesh.is_flat

  std::unique_ptr<GroundMaker> ground_;
};

// The header attributes of a tile.
TileAttributes tile_attributes(const TileKey& key, std::span<const float> heights_m);

}  // namespace lodestone
