#pragma once
// Uploaded mask bytes to 8-bit grey pixels with their place. The bytes are hostile until proven otherwise.

#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "kernels/types/result.h"

namespace lodestone {

// Row-major from the raster's first row; 255 is white.
struct GreyRaster {
  int width = 0, height = 0;
  std::vector<std::uint8_t> pixels;
  std::optional<std::array<double, 6>>
      transform;        // GDAL's, of pixel corners; none: to be stretched over the layer
  std::string crs_wkt;  // empty with a transform: the layer's own
};

// By magic bytes: PNG, EXR, GeoTIFF. Checks declared sizes first. Errors as MaskStore::put().
Result<GreyRaster> decode_mask(std::span<const std::uint8_t> bytes);

}  // namespace lodestone
