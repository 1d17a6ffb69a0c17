#pragma once
// FractalTask: everything that midpoint displacement or the fractal wavelet needs for one tile, as plain
// values. Sources: Hu & Wang; Ostrowski; SPEC-SYNTHESIS sections 5 and 6.

#include <cstdint>
#include <optional>
#include <vector>

#include "kernels/fractal/node_roughness.h"
#include "kernels/synthesis/wavelet_task.h"
#include "kernels/types/mask_crop.h"
#include "kernels/types/post_window.h"
#include "kernels/types/result.h"

namespace lodestone {

enum class FractalMethod : std::uint8_t { kSquareSquare, kDiamondSquare, kFractalWavelet };
// kTriangle keeps the volume; kPublished are the printed constants 1/16, 15/16, 1/32, which do not.
enum class VolumeRule : std::uint8_t { kTriangle, kPublished };
// Deviation between nodes: bilinear between their centres, or the mean of the nodes that touch the point.
enum class NodeLookup : std::uint8_t { kSmooth, kConstant };

// Factor on the displacement: lo at and below z0, hi at and above z1, linear between.
struct AltitudeRule {
  float z0_m = 0, z1_m = 1, lo = 1, hi = 1;
  bool operator==(const AltitudeRule&) const = default;
};

struct FractalParameters {
  NodeLookup lookup = NodeLookup::kSmooth;
  // The rest is for kFractalWavelet only.
  VolumeRule volume = VolumeRule::kTriangle;
  std::optional<AltitudeRule> altitude;
  std::optional<float> cap_m;    // largest displacement
  bool erosion = false;          // no new point below the lowest of its four neighbours ..
  std::optional<float> water_m;  // .. where the ground is above this level
  int channel = 0;               // 0 heights, 1..3 colours of an image
  bool is_flora = false;         // a density of plants: random numbers of its own
  bool operator==(const FractalParameters&) const = default;
};

// One tile: `posts` x `posts` output posts, the first at (x0, y0) of level base_level + depth. Any rectangle
// position is fine.
struct FractalTask {
  PostWindow world;  // the data at the base level, at least 2 x 2 posts
  int base_level = 0;
  int depth = 1;  // 1..kMaxDepth
  std::int64_t x0 = 0, y0 = 0;
  int posts = 257;  // 1..2049
  std::uint64_t seed = 0;
  FractalMethod method = FractalMethod::kSquareSquare;
  FractalParameters parameters;

  std::vector<float> coarse_m;  // heights of coarse_window(*this), row-major, finite
  NodeCrop nodes;               // holds node_window(*this)

  // User mask (absent = all 0), void mask (cells with a void corner 255, level 0). Both hold
  // mask_window(*this, level). A displacement is multiplied by sqrt(1 - mask), the mask bilinear between
  // pixel centres at the point: its energy falls by the mask. White pixels of void_mask, and of mask in
  // kProtect, are hard: a displacement whose support (three new posts to each side) meets one is dropped, so
  // such a pixel, border included, holds the method's own refinement without displacement. Masking never
  // changes the random numbers.
  std::optional<MaskCrop> mask;
  MaskMode mask_mode = MaskMode::kAbsorb;
  std::optional<MaskCrop> void_mask;
};

// Base posts that the task needs, inside the world: coarse(x0 .. x0 + posts - 1, depth) and 1 post around for
// square-square, 2 for diamond-square, 4 for the fractal wavelet with altitude or erosion rules, none for it
// without.
PostWindow coarse_window(const FractalTask& task);

// Nodes that the task needs, within the layer; node_log2 2..kMaxNodeLog2.
PostWindow node_window(const FractalTask& task, int node_log2);

// Mask pixels of level `mask_level` that the task needs, in MaskCrop's pixel coordinates.
PostWindow mask_window(const FractalTask& task, int mask_level);

// Every rule above. Errors: kInvalidArgument, naming the member.
Result<void> check(const FractalTask& task);

}  // namespace lodestone
