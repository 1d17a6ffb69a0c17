#pragma once
// Roughness of real terrain: band variances, the fit of their power law (GSA) and the local maps (LSA).
// Sources: Perez et al. eq. 7, 8; SPEC-SYNTHESIS 3.1-3.5. All arithmetic in double with + - * / and our own log2/exp2, so that
// every machine gets the same bits; results are rounded once to float32.

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "kernels/synthesis/wavelet_task.h"
#include "kernels/types/analysis.h"
#include "kernels/types/height_grid.h"
#include "kernels/types/post_window.h"

namespace lodestone {

// Deterministic base-2 logarithm (x > 0, normal) and power (|x| < 1000); relative error below 1e-14.
double det_log2(double x);
double det_exp2(double x);

enum class FitWeights : std::uint8_t { kWeighted, kPaper };

// log2 V_s = a - gamma s (s = -1 finest real level, 0 first new one). SPEC-SYNTHESIS 3.2, edge cases included.
struct BandFit {
  double a = 0;
  double gamma = 1.6;
  bool is_flat = false;     // finest variance <= 2^-40: sigma is 0 at every new level
  bool is_clamped = false;  // gamma had to be clamped to [0.2, 4]
  int levels_used = 0;
  float s0 = 0;  // 2^(a/2), 0 when flat
  float q = 1;   // 2^(-gamma/2)
};

// finest_first[n] is the variance at s = -1 - n of one band.
BandFit fit_band(std::span<const BandVariance> finest_first, FitWeights weights);
// The three bands of a layer.
std::array<BandFit, 3> fit_layer(std::span<const LevelVariance> finest_first, FitWeights weights);

struct LsaParameters {
  int window = 3;        // 1, 3, 5, 7
  int levels = 3;        // J, 1..6
  double trust = 0.25;   // share of the local slope, 0..1
  bool match_energy = true;
  FitWeights fit = FitWeights::kWeighted;
  bool operator==(const LsaParameters&) const = default;
};

// Fine posts (global indices, clamped to the fine level's `world`) that analyse() reads for the coarse posts `coarse`.
PostWindow analysis_window(const PostWindow& coarse, const PostWindow& world);
// One step of the CDF(2,2) analysis of a rectangle of a level, border of `world` mirrored (SPEC-SYNTHESIS section 2).
//   fine    must cover analysis_window(coarse, world);  world: all posts of the fine level, global indices
//   coarse  within coarse_world(world)
// A coefficient or coarse post is valid iff every post under its filter is (mirrored posts count as their originals).
// Same bits as the OpenCL forward lifting.
AnalysisStep analyse(const HeightGrid& fine, const PostWindow& world, const PostWindow& coarse);

// Size of one band's LSA map: its coefficients at the finest real level. world.i0 and j0 are even there.
// {map_width, map_height}: odd direction floor(n / 2), even direction ceil(n / 2) of the world's n posts.
std::array<std::int64_t, 2> sigma_map_size(const PostWindow& world, int band);

// What lsa_maps() has to be given for map entries `entries` (local: counted from the map's corner): for detail level
// l = 1..levels, the analysis of the layer's level base - (l - 1) over the coarse posts needs[l - 1] (global coarse indices).
// Fewer than `levels` entries when the layer is too small for more. world: posts of the base level.
std::vector<PostWindow> lsa_needs(const PostWindow& entries, const PostWindow& world, const LsaParameters& parameters);

// LSA map entries `entries` (local, clamped to each band's map) of the three bands. SPEC-SYNTHESIS 3.4.
//   steps[l - 1]  analysis covering lsa_needs()[l - 1];  fits: the layer's GSA fit with the same FitWeights
// s0 = 0 where the finest local variance is at most 2^-40.
std::array<SigmaMap, 3> lsa_maps(const PostWindow& entries, const PostWindow& world, std::span<const AnalysisStep> steps,
                                 std::span<const BandFit, 3> fits, const LsaParameters& parameters);

// Sums of (s0 q^s)^2 over map entries for s = 0..kMaxDepth-1, to be added up over the whole map in a fixed order.
struct LsaEnergy {
  std::array<std::array<double, kMaxDepth>, 3> sum{};
  std::array<std::int64_t, 3> count{};
};
LsaEnergy lsa_energy(const std::array<SigmaMap, 3>& maps);
// kappa_s of SPEC-SYNTHESIS 3.4 into bands[t].kappa (1 when match_energy is false or the mean is 0); s0 and q from the fit.
std::array<BandSigma, 3> band_sigmas(std::span<const BandFit, 3> fits, const LsaEnergy* energy, bool match_energy);

}  // namespace lodestone
