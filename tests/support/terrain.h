#pragma once
// Generated terrain for tests: endless, addressed by global post, so that neighbouring tiles share their edge
// posts.

#include <cmath>
#include <cstdint>
#include <vector>

namespace lodestone::test {

inline double hash01(std::int64_t i, std::int64_t j, std::uint64_t seed) {
  std::uint64_t z = seed * 0x9E3779B97F4A7C15ULL ^ static_cast<std::uint64_t>(i) * 0xBF58476D1CE4E5B9ULL ^
                    static_cast<std::uint64_t>(j) * 0x94D049BB133111EBULL;
  z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9ULL;
  z = (z ^ z >> 27) * 0x94D049BB133111EBULL;
  return static_cast<double>((z ^ z >> 31) >> 11) * 0x1p-53;
}

// Fractal value noise, metres; about +-relief_m.
inline double terrain_m(std::int64_t i, std::int64_t j, std::uint64_t seed, double relief_m = 400) {
  double sum = 0, amplitude = relief_m;
  for (int octave = 7; octave >= 0; --octave, amplitude *= 0.5) {
    const std::int64_t ci = i >> octave, cj = j >> octave;
    const double u = static_cast<double>(i - (ci << octave)) / static_cast<double>(1 << octave);
    const double v = static_cast<double>(j - (cj << octave)) / static_cast<double>(1 << octave);
    const double su = u * u * (3 - 2 * u), sv = v * v * (3 - 2 * v);
    const std::uint64_t s = seed + static_cast<std::uint64_t>(octave);
    const double north = hash01(ci, cj, s) * (1 - su) + hash01(ci + 1, cj, s) * su;
    const double south = hash01(ci, cj + 1, s) * (1 - su) + hash01(ci + 1, cj + 1, s) * su;
    sum += amplitude * (2 * (north * (1 - sv) + south * sv) - 1);
  }
  return sum;
}

enum class Kind { kFloat, kInteger, kPlateau, kFlat, kPlane };
inline float sample_m(Kind kind, std::int64_t i, std::int64_t j, std::uint64_t seed) {
  const double h = terrain_m(i, j, seed);
  switch (kind) {
    case Kind::kFloat:
      return static_cast<float>(h);
    case Kind::kInteger:
      return static_cast<float>(std::floor(h + 0.5));
    case Kind::kPlateau:
      return static_cast<float>(std::floor(h / 60) * 60);
    case Kind::kPlane:
      return static_cast<float>(3 * i - 2 * j);
    default:
      return 100;
  }
}

// (cols + 2 halo) * (rows + 2 halo) heights around the window whose north-west post is (i0, j0).
inline std::vector<float> heights_of(Kind kind, std::int64_t i0, std::int64_t j0, int cols, int rows,
                                     int halo, std::uint64_t seed) {
  std::vector<float> heights;
  for (int r = -halo; r < rows + halo; ++r) {
    for (int c = -halo; c < cols + halo; ++c) heights.push_back(sample_m(kind, i0 + c, j0 + r, seed));
  }
  return heights;
}

}  // namespace lodestone::test
