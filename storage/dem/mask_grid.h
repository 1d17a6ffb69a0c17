#pragma once
// The pixel grid of masks on a layer, and the warp of a decoded mask to it.

#include <array>
#include <cstdint>
#include <map>
#include <utility>
#include <vector>

#include "kernels/types/result.h"
#include "storage/dem/layer_info.h"
#include "storage/dem/mask_decode.h"

namespace lodestone {

inline constexpr int kMaskTile = 256;  // pixels per tile edge, on disk

// Pixels of the whole world at `level`: 2^level per data cell, rounded up.
std::int64_t mask_pixels(std::int64_t cells, int level);
// GDAL's transform of that grid's pixel corners in the layer's CRS.
std::array<double, 6> mask_transform(const LayerInfo& layer, int level);

// A mask on the layer: tiles that are not all 0, row-major kMaskTile^2 bytes (0 beyond the world), by {tile
// row, tile column}.
struct WarpedMask {
  int level = 0;
  std::map<std::pair<std::int64_t, std::int64_t>, std::vector<std::uint8_t>> tiles;
  double mean = 0;  // 0..1, of all pixels of the world
};
// Chooses the level and brings the mask there. Errors: kInvalidArgument (layer without cells, mask beside
// it), kUnsupported (CRS).
Result<WarpedMask> warp_mask(const GreyRaster& mask, const LayerInfo& layer);

}  // namespace lodestone
