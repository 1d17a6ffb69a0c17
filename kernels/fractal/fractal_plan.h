#pragma once
// FractalPlan: a task unrolled into the operations that both backends carry out in the same order. Internal
// to the room.

#include <array>
#include <cstdint>
#include <vector>

#include "kernels/fractal/fractal_task.h"
#include "kernels/shared/ls_fractal.h"

namespace lodestone {

// Planes of floats. Each has LS_FRACTAL_GUARD unused floats before its first element and after its last.
enum FractalSlot : std::uint8_t {
  kSlotHeightsA,
  kSlotHeightsB,  // levels, alternating; the data lies in A
  kSlotDelta1,
  kSlotDelta2,
  kSlotDelta3,  // displacements: horizontal edges (or square-square), vertical edges, centres
  kSlotWeight1,
  kSlotWeight2,
  kSlotWeight3,  // theta * displacement
  kSlotPosts,
  kSlotCentres,
  kSlotPosts2,
  kSlotCentres2,
  kSlotRows,  // node deviations along one row of items
  kSlotTable,
  kSlotKeep,  // whole task: node deviations; mask factors
  kSlotCount
};

// The kernels of fractal.cl, in its order; each takes an ls_step and then the planes of FractalOp::slots.
enum FractalKernel : std::uint8_t {
  kKernelNodeRows,         // table, rows
  kKernelNoise,            // rows, delta
  kKernelScale,            // keep, delta
  kKernelSquareFirst,      // heights, delta, heights
  kKernelSquareNext,       // heights, delta, heights
  kKernelSquareNextInner,  // the same away from the border
  kKernelSquarePosts,      // heights, heights
  kKernelSquarePostsInner,
  kKernelDiamondCentres,     // heights, delta, centres
  kKernelDiamondQuads,       // heights, centres, delta, delta, heights
  kKernelDiamondQuadsInner,  // the same away from the border
  kKernelRuleCentres,        // heights, delta
  kKernelWeights,            // delta, weight
  kKernelWeightsInner,       // the same away from the border
  kKernelHalf1Posts,         // heights, weight, posts
  kKernelHalf1Centres,       // posts, delta, centres
  kKernelRuleEdges,          // posts, centres, delta
  kKernelHalf2Old,           // posts, centres, weight, weight, posts2, centres2
  kKernelHalf2Quads,         // posts2, centres2, delta, delta, heights
  kKernelCount
};
const char* kernel_name(FractalKernel kernel);
// Takes 16 items of a row of pitch items per work-item.
bool is_sixteen_wide(FractalKernel kernel);

struct FractalOp {
  FractalKernel kernel;
  int columns, rows;  // items
  ls_step step;
  std::array<FractalSlot, 6> slots;
  int slot_count;
};

struct FractalPlan {
  std::vector<FractalOp> ops;
  std::array<std::size_t, kSlotCount> floats{};  // size of each plane without its guard
  std::vector<float> heights, table, keep;       // contents of kSlotHeightsA, kSlotTable, kSlotKeep
  FractalSlot out = kSlotHeightsA;
  std::size_t out_at = 0, out_pitch = 0;  // where the tile's first post lies
};

// task must pass check().
FractalPlan make_plan(const FractalTask& task);

// Mask factors sqrt(1 - mask), 0 where a hard pixel is near, of columns x rows points: point (i, j) lies at
// (x0 + 2i, y0 + 2j) * 2^-shift data cells from the world's corner. Empty when all are 1.
std::vector<float> mask_factors(const FractalTask& task, std::int64_t x0, std::int64_t y0, int shift,
                                int columns, int rows, int pitch);

}  // namespace lodestone
