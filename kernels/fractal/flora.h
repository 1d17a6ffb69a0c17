#pragma once
// Colouring of terrain by what grows there: altitude, slope and a density of plants.
// Source: Ostrowski's closing remark on floral distribution; SPEC-SYNTHESIS 6.6. The density is a coarse
// raster in 0..1 that the fractal wavelet refines (FractalParameters::is_flora gives it its own random
// numbers).

#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

namespace lodestone {

enum class FloraClass : std::uint8_t { kWater, kSand, kSnow, kRock, kForest, kGrass, kBare };
inline constexpr int kFloraClasses = 7;

struct FloraRules {
  std::optional<float> water_m;  // no water or sand without it
  float tree_line_m = 2500;
  float snow_line_m = 3500;
};

using Rgb = std::array<std::uint8_t, 3>;
// The colours that a configuration starts from, by FloraClass.
inline constexpr std::array<Rgb, kFloraClasses> kFloraColours = {{{66, 108, 148},
                                                                  {214, 197, 150},
                                                                  {244, 247, 250},
                                                                  {136, 126, 118},
                                                                  {62, 96, 58},
                                                                  {128, 152, 84},
                                                                  {170, 150, 116}}};

// slope: rise over run; density outside 0..1 counts as the nearer end.
FloraClass classify_flora(float height_m, float slope, float density, const FloraRules& rules);

// Moisture-like density from curvature: 1/2 on even ground, more in hollows, less on ridges; 0..1. around_m:
// mean of the four neighbours at spacing_m.
float density_from_curvature(float height_m, float around_m, float spacing_m);

// Classes of the inner posts of a grid: heights_m is (width + 2) * (height + 2) with a ring of one post,
// density width * height or empty (then density_from_curvature()). spacing_x_m, spacing_y_m > 0.
std::vector<FloraClass> flora_of_grid(std::span<const float> heights_m, std::span<const float> density,
                                      int width, int height, float spacing_x_m, float spacing_y_m,
                                      const FloraRules& rules);

}  // namespace lodestone
