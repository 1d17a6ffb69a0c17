#include "kernels/fractal/flora.h"

#include <algorithm>
#include <cassert>
#include <cmath>

namespace lodestone {

FloraClass classify_flora(float height_m, float slope, float density, const FloraRules& rules) {
  constexpr float kBeach_m = 3.0F;
  if (rules.water_m) {
    if (height_m < *rules.water_m) return FloraClass::kWater;
    if (height_m < *rules.water_m + kBeach_m && slope < 0.1F) return FloraClass::kSand;
  }
  if (height_m > rules.snow_line_m && slope < 1.0F) return FloraClass::kSnow;
  if (slope > 1.0F || height_m > rules.tree_line_m) return FloraClass::kRock;
  if (density >= 0.5F) return FloraClass::kForest;
  return density >= 0.2F ? FloraClass::kGrass : FloraClass::kBare;
}

float density_from_curvature(float height_m, float around_m, float spacing_m) {
  return std::clamp(0.5F + 2.0F * (around_m - height_m) / spacing_m, 0.0F, 1.0F);
}

std::vector<FloraClass> flora_of_grid(std::span<const float> heights_m, std::span<const float> density,
                                      int width, int height, float spacing_x_m, float spacing_y_m,
                                      const FloraRules& rules) {
  const std::size_t pitch = static_cast<std::size_t>(width) + 2;
  assert(heights_m.size() == pitch * (static_cast<std::size_t>(height) + 2) &&
         "heights need a ring of one post");
  assert((density.empty() ||
          density.size() == static_cast<std::size_t>(width) * static_cast<std::size_t>(height)) &&
         "one density per post");
  const float spacing_m = (spacing_x_m + spacing_y_m) * 0.5F;
  std::vector<FloraClass> classes;
  classes.reserve(static_cast<std::size_t>(width) * static_cast<std::size_t>(height));
  for (std::size_t j = 0; j < static_cast<std::size_t>(height); ++j) {
    for (std::size_t i = 0; i < static_cast<std::size_t>(width); ++i) {
      const float* h = heights_m.data() + (j + 1) * pitch + i + 1;
      const float west = h[-1], east = h[1], north = *(h - pitch), south = h[pitch];
      const float dx = (east - west) / (2.0F * spacing_x_m), dy = (south - north) / (2.0F * spacing_y_m);
      const float rho = density.empty()
                            ? density_from_curvature(*h, ((west + east) + (north + south)) * 0.25F, spacing_m)
                            : density[classes.size()];
      classes.push_back(classify_flora(*h, std::sqrt(dx * dx + dy * dy), rho, rules));
    }
  }
  return classes;
}

}  // namespace lodestone
