#pragma once
// Terrain for tests and benchmarks: five octaves of smooth lattice noise, the same on every run and machine.

#include <cmath>
#include <cstdint>
#include <vector>

namespace lodestone {

inline float lattice_value(std::uint32_t column, std::uint32_t row) {  // [-1, 1)
  std::uint32_t h = column * 0x9E3779B1u ^ (row * 0x85EBCA77u + 0x165667B1u);
  h = (h ^ (h >> 15)) * 0x2C1B3C6Du;
  h = (h ^ (h >> 12)) * 0x297A2D39u;
  return static_cast<float>((h ^ (h >> 15)) >> 8) * (1.0f / 8388608.0f) - 1.0f;
}

// edge * edge heights in metres, row 0 north: about 400 to 1100 m, hills of 128 posts down to bumps of 0.35 m between posts.
inline std::vector<float> sample_terrain(int edge) {
  std::vector<float> heights_m(static_cast<std::size_t>(edge) * edge);
  for (int row = 0; row < edge; ++row) {
    for (int column = 0; column < edge; ++column) {
      float height_m = 750.0f + 0.35f * lattice_value(column + 7919u, row + 104729u);
      float amplitude_m = 160.0f;
      for (int cell = 128; cell >= 8; cell /= 2, amplitude_m *= 0.5f) {
        const std::uint32_t i = column / cell, j = row / cell;
        const float u = static_cast<float>(column % cell) / cell, v = static_cast<float>(row % cell) / cell;
        const float su = u * u * (3 - 2 * u), sv = v * v * (3 - 2 * v);
        const float north = lattice_value(i, j) * (1 - su) + lattice_value(i + 1, j) * su;
        const float south = lattice_value(i, j + 1) * (1 - su) + lattice_value(i + 1, j + 1) * su;
        height_m += amplitude_m * (north * (1 - sv) + south * sv);
      }
      heights_m[static_cast<std::size_t>(row) * edge + column] = height_m;
    }
  }
  return heights_m;
}

}  // namespace lodestone
