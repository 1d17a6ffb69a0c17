#pragma once
// HeightGrid: a rectangle of heights with its place on a level.

#include <cstddef>
#include <cstdint>
#include <vector>

#include "kernels/types/post_window.h"

namespace lodestone {

// heights_m: row 0 north, window.width() * window.height() float32 metres, always finite (voids are filled).
// is_void: empty when every post is surveyed, else one byte per post, 1 = void (its height is a fill).
struct HeightGrid {
  PostWindow window;
  std::vector<float> heights_m;
  std::vector<std::uint8_t> is_void;

  std::size_t index(std::int64_t i, std::int64_t j) const {
    return static_cast<std::size_t>((j - window.j0) * window.width() + (i - window.i0));
  }
  float at(std::int64_t i, std::int64_t j) const { return heights_m[index(i, j)]; }
  bool void_at(std::int64_t i, std::int64_t j) const { return !is_void.empty() && is_void[index(i, j)] != 0; }
};

}  // namespace lodestone
