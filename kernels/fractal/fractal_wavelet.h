#pragma once
// The fractal wavelet as a transform of whole grids: refine by given details, reduce to a coarser grid and
// its details. Heights of a level and channels of an image alike (one channel at a time; clamp colours only
// on output). Source: Ostrowski; SPEC-SYNTHESIS 6.2, 6.3. Same arithmetic as the tiles of FractalSynthesis.

#include <array>
#include <cstdint>
#include <vector>

#include "kernels/fractal/fractal_task.h"
#include "kernels/types/height_grid.h"
#include "kernels/types/result.h"

namespace lodestone {

// kRule: shares re-derived where cells are missing. kPeriodic: the grid is a torus of width x height cells
// (even numbers), its last column is followed by its first.
enum class FractalBorder : std::uint8_t { kRule, kPeriodic };

struct FractalWaveletOptions {
  VolumeRule volume = VolumeRule::kTriangle;
  FractalBorder border = FractalBorder::kRule;
};

// Displacements of one level, metres, each array coarse.width() * coarse.height(), entry (i, j) for the new
// point at fine post (2i + 1, 2j), (2i, 2j + 1), (2i + 1, 2j + 1). Entries whose point does not exist are 0.
struct FractalDetail {
  PostWindow coarse;
  std::array<std::vector<float>, 3> delta_m;  // horizontal edges, vertical edges, centres
};

// One level finer. `coarse` is the whole world of its level (global indices: the diagonals follow i + j).
// Errors: kInvalidArgument (sizes; odd sizes with kPeriodic).
Result<HeightGrid> refine(const HeightGrid& coarse, const FractalDetail& detail,
                          const FractalWaveletOptions& options);

struct FractalReduction {
  HeightGrid coarse;
  FractalDetail detail;
};

// Posts of the fine level, within `world`, that reduce() reads for the coarse posts `coarse`.
PostWindow reduction_window(const PostWindow& coarse, const PostWindow& world);

// The inverse of refine() for the coarse posts `coarse`. fine must hold reduction_window(); world: all posts
// of the fine level. A world that begins or ends on an odd post is mirrored by one post there. With
// kPeriodic, fine and coarse are whole worlds. refine(reduce(x)) = x and reduce(refine(x)) = x within 2^-20
// max|h| per level. Errors: kInvalidArgument.
Result<FractalReduction> reduce(const HeightGrid& fine, const PostWindow& world, const PostWindow& coarse,
                                const FractalWaveletOptions& options);

// Volume under the surface in cells * metres: triangles whose diagonals join the corners with even i + j.
double surface_volume(const HeightGrid& grid, FractalBorder border);

}  // namespace lodestone
