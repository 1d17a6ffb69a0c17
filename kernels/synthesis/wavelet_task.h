#pragma once
// WaveletTask: everything that the wavelet synthesis of one tile depends on, as plain values.
// Sources: Perez et al. eq. 6 (GSA), 8 (LSA), 9 (MGR); SPEC-SYNTHESIS sections 2-4.

#include <array>
#include <cstdint>
#include <optional>
#include <vector>

#include "kernels/types/mask_crop.h"
#include "kernels/types/post_window.h"

namespace lodestone {

// Deepest synthetic level below the base level.
inline constexpr int kMaxDepth = 16;

enum class WaveletMethod : std::uint8_t { kLinear, kGsa, kLsa };
// kCdf22: the spline-linear LeGall 5/3 wavelet. kCdf44: cubic, for comparison only (posts move with zero detail).
enum class WaveletBasis : std::uint8_t { kCdf22, kCdf44 };
// How LSA reads its map between entries: bilinear, or the nearest entry ("related to the current point" in the paper).
enum class SigmaLookup : std::uint8_t { kSmooth, kNearest };
enum class MaskMode : std::uint8_t { kAbsorb, kProtect };

// Deviations of one band (index 0, 1, 2 = d1 horizontal, d2 vertical, d3 diagonal), metres.
// GSA: sigma_s = ((s0 q) q).. for new level s = 0, 1, ..; kappa is not used.
// LSA: sigma_s = (s0(r) q(r) .. q(r)) kappa[s], with s0, q from the band's SigmaMap.
struct BandSigma {
  float s0 = 0;
  float q = 1;
  std::array<float, kMaxDepth> kappa{};
};

// A rectangle of one band's LSA map. Entry (I, J) of the whole map belongs to coefficient (I, J) of the finest real level,
// counted from the layer's north-west corner; s0 and q are row-major, width * height entries from (i0, j0).
struct SigmaMap {
  std::int64_t i0 = 0, j0 = 0;
  int width = 0, height = 0;
  std::int64_t map_width = 0, map_height = 0;  // of the whole map
  std::vector<float> s0, q;
};

// One tile to synthesise: `posts` x `posts` output posts, the first one at (x0, y0) in the global index space of
// level base_level + depth. posts - 1 is a power of two and divides x0 and y0.
struct WaveletTask {
  PostWindow world;  // the data at the base level; synthesis mirrors at its border
  int base_level = 0;
  int depth = 1;  // 1..kMaxDepth
  std::int64_t x0 = 0, y0 = 0;
  int posts = 257;
  std::uint64_t seed = 0;
  WaveletMethod method = WaveletMethod::kLinear;
  WaveletBasis basis = WaveletBasis::kCdf22;
  SigmaLookup lookup = SigmaLookup::kSmooth;

  // Heights of coarse_window(*this), row-major, finite.
  std::vector<float> coarse_m;
  std::array<BandSigma, 3> bands;
  std::array<SigmaMap, 3> maps;  // kLsa only; must hold sigma_window(*this, band)

  // User mask; absent = all 0. Must hold mask_window(*this, level). mask_mode applies to this one only.
  std::optional<MaskCrop> mask;
  MaskMode mask_mode = MaskMode::kAbsorb;
  // Data cells with a void corner as 255, others 0, level 0: always treated as kProtect. Absent = no voids near.
  std::optional<MaskCrop> void_mask;
};

// Posts of the base level that the task needs: coarse(x0 .. x0 + posts - 1, depth) of SPEC-SYNTHESIS section 2 (no halo for
// kCdf22; two posts more on each side for kCdf44). May reach beyond the world: those posts are the mirrored ones.
PostWindow coarse_window(const WaveletTask& task);

// Map entries of `band` (0..2) that the task needs, clamped to the whole map; map_width/height from the task's maps[band].
PostWindow sigma_window(const WaveletTask& task, int band);

// Mask pixels of level `mask_level` that the task needs (2.5 data cells around the tile), in MaskCrop's pixel coordinates.
PostWindow mask_window(const WaveletTask& task, int mask_level);

}  // namespace lodestone
