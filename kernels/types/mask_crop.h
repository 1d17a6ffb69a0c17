#pragma once
// MaskCrop: a rectangle of mask pixels on a layer's data cells.

#include <cstdint>
#include <vector>

namespace lodestone {

// Level 0: one pixel per data cell; level mu: 2^mu pixels per cell edge (mu may be negative).
// Pixel (0, 0) has its north-west corner on the layer's north-west data post. Row-major, width * height pixels from (i0, j0);
// 0 keeps all detail energy, 255 (white, 1.0) removes it. Pixels beyond the world have been filled in by mirroring.
struct MaskCrop {
  int level = 0;
  std::int64_t i0 = 0, j0 = 0;
  int width = 0, height = 0;
  std::vector<std::uint8_t> pixels;
};

}  // namespace lodestone
