#pragma once
// Plain results of the CDF(2,2) analysis of one level, shared by the kernels that make them and the store that keeps them.

#include <array>
#include <cstdint>
#include <vector>

#include "kernels/types/post_window.h"

namespace lodestone {

// Mean square and number of the valid coefficients of one band of one level.
struct BandVariance {
  double variance_m2 = 0;
  std::int64_t count = 0;
};
using LevelVariance = std::array<BandVariance, 3>;  // d1 horizontal, d2 vertical, d3 diagonal

// One analysis step over a rectangle of coarse posts, in the global indices of the coarse level: coarse post I lies on fine post
// 2I, detail I on fine post 2I + 1 (in the band's odd directions) or 2I (even).
struct AnalysisStep {
  PostWindow coarse;
  std::vector<float> low_m;            // coarse.width() * coarse.height(), metres
  std::vector<std::uint8_t> low_void;  // 1 = some post under the low-pass is void; empty if all are valid
  // Same shape. Entries whose fine post lies outside the fine level's world are 0 and flagged.
  std::array<std::vector<float>, 3> detail_m;
  std::array<std::vector<std::uint8_t>, 3> detail_void;
};

// Coarse posts that lie on posts of `world` (one level finer); where there is none, the single one to the north or west.
inline PostWindow coarse_world(const PostWindow& world) {
  PostWindow w{ceil_shift(world.i0, 1), ceil_shift(world.j0, 1), floor_shift(world.i1, 1), floor_shift(world.j1, 1)};
  if (w.i1 < w.i0) w.i0 = w.i1;
  if (w.j1 < w.j0) w.j0 = w.j1;
  return w;
}

}  // namespace lodestone
