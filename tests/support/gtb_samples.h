#pragma once
// Small terrain and images for the tests of the Geometric-Textured Bitree.

#include <cmath>
#include <random>

#include "kernels/mesh/bitree.h"
#include "kernels/types/rgb_image.h"
#include "tests/support/terrain.h"

namespace lodestone::test {

inline Bitree terrain_tree(int side, double max_error_m, double step_m, std::uint64_t seed = 4) {
  const std::vector<float> heights = heights_of(Kind::kInteger, 3, 8, side, side, 0, seed);
  BitreeRequest request;
  request.field = {heights, {}, side, side, 0};
  request.max_error_m = max_error_m;
  request.z_step_m = step_m;
  Result<Bitree> tree = build_bitree(request);
  return tree ? std::move(*tree) : Bitree{};
}

// Land in a few colours with grain, in patches tens of pixels wide.
inline RgbImage patchy_image(int width, int height, std::uint64_t seed = 1) {
  constexpr double kColours[4][3] = {{30, 60, 140}, {40, 110, 50}, {190, 170, 110}, {120, 120, 125}};
  RgbImage image{width, height, {}};
  for (int row = 0; row < height; ++row) {
    for (int col = 0; col < width; ++col) {
      const double h = terrain_m(col, row, seed, 100);
      const auto& colour = kColours[h < -40 ? 0 : h < 20 ? 1 : h < 60 ? 2 : 3];
      for (const double c : colour) image.rgb.push_back(static_cast<std::uint8_t>(std::floor(c + 16 * hash01(col, row, seed + 77) - 8)));
    }
  }
  return image;
}

}  // namespace lodestone::test
