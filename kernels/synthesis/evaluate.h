#pragma once
// Hold-out metrics: how well synthetic levels continue real ones. SPEC-SYNTHESIS section 9, items 5-7.

#include <cstdint>
#include <span>
#include <vector>

#include "kernels/synthesis/roughness.h"
#include "kernels/types/height_grid.h"

namespace lodestone {

struct HoldOutMetrics {
  double band_rms = 0;        // rms over bands and levels of log2(V_syn / V_real)
  double rough_corr = 0;      // correlation of log2 box energies, 9x9 coefficients of the finest level, floor 1e-4 of the mean
  double slope_real = 0;      // slope of the radial power spectrum on [2^-(k+2), 0.45] cycles per post
  double slope_synthetic = 0;
  double kurtosis_real = 0;   // of the finest diagonal details
  double kurtosis_synthetic = 0;
  std::vector<std::array<double, 3>> log2_variance_ratio;  // [level, finest first][band] log2(V_syn / V_real)
};

// real, synthetic: the same window, all posts of the level; void posts are left out of the statistics. k: levels held out.
HoldOutMetrics compare_levels(const HeightGrid& real, const HeightGrid& synthetic, int k);

}  // namespace lodestone
