#pragma once
// Rectangles of the steps that lead from the data to a tile. Internal to the room.

#include <cstdint>
#include <vector>

#include "kernels/fractal/fractal_task.h"

namespace lodestone {

// One step from level s to s + 1, in indices of level s: posts, or cells in square-square after the first
// step (whose items are data cells).
struct FractalStep {
  PostWindow items;   // what the step's functions run over
  PostWindow needed;  // parent values that they need
};

// All steps, s = 0 first.
std::vector<FractalStep> fractal_steps(const FractalTask& task);

// Whether displacements depend on heights, so that heights around the tile are needed.
bool reads_heights(const FractalTask& task);

// Where the displacements of band `band` (0 square-square, 1, 2, 3) of step s lie: item (0, 0) in units of
// 2^-shift data cells from the world's corner; consecutive items differ by 2.
struct BandPlace {
  std::int64_t x0, y0;
  int shift;
};
BandPlace band_place(const FractalTask& task, const FractalStep& step, int s, int band);

// Range of nodes that the points t0, t0 + 2, .. of one axis touch.
struct NodeRange {
  std::int64_t first, last;
};
NodeRange node_range(std::int64_t x0, int count, int shift, int node_log2, NodeLookup lookup,
                     std::int64_t nodes);

// Node coordinate of ls_nodes_at().
std::int64_t node_coordinate(std::int64_t x0, int shift, int node_log2, NodeLookup lookup);

}  // namespace lodestone
