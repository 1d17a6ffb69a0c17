// Band variances to power laws (GSA), and the energy that LSA has to match.
// Source: Perez et al. eq. 7; SPEC-SYNTHESIS 3.2-3.4.

#include "kernels/synthesis/roughness.h"

#include <algorithm>
#include <cassert>
#include <cmath>

#include "kernels/synthesis/det_math.h"

namespace lodestone {
namespace {

constexpr double kFlatVariance = 0x1p-40;  // m^2
constexpr double kGammaMin = 0.2, kGammaMax = 4.0, kGammaDefault = 1.6;
constexpr std::int64_t kMinCount = 16;

// Weighted least squares of y = log2 V over s; gamma is minus the slope.
struct LineSums {
  double w = 0, s = 0, y = 0, ss = 0, sy = 0;
  void add(double weight, double at, double value) {
    w += weight;
    s += weight * at;
    y += weight * value;
    ss += weight * at * at;
    sy += weight * at * value;
  }
};

}  // namespace

double det_log2(double x) { return det::log2(x); }
double det_exp2(double x) { return det::exp2(x); }

BandFit fit_band(std::span<const BandVariance> finest_first, FitWeights weights) {
  BandFit fit;
  fit.gamma = kGammaDefault;
  fit.is_flat = finest_first.empty() || !(finest_first[0].variance_m2 > kFlatVariance);
  if (fit.is_flat) {
    fit.q = static_cast<float>(det::exp2(-0.5 * fit.gamma));
    return fit;
  }
  LineSums sums;
  for (std::size_t n = 0; n < finest_first.size(); ++n) {
    const BandVariance& v = finest_first[n];
    if (v.count < kMinCount || !(v.variance_m2 > kFlatVariance)) continue;
    const double weight = weights == FitWeights::kWeighted ? static_cast<double>(v.count) : 1.0;
    sums.add(weight, -1.0 - static_cast<double>(n), det::log2(v.variance_m2));
    ++fit.levels_used;
  }
  if (fit.levels_used < 2) {
    fit.a = det::log2(finest_first[0].variance_m2) - fit.gamma;
  } else {
    const double mean_s = sums.s / sums.w;
    const double mean_y = sums.y / sums.w;
    const double gamma = -(sums.sy - sums.s * mean_y) / (sums.ss - sums.s * mean_s);
    fit.gamma = std::clamp(gamma, kGammaMin, kGammaMax);
    fit.is_clamped = fit.gamma != gamma;
    fit.a = mean_y + fit.gamma * mean_s;
  }
  fit.s0 = static_cast<float>(det::exp2(0.5 * fit.a));
  fit.q = static_cast<float>(det::exp2(-0.5 * fit.gamma));
  return fit;
}

std::array<BandFit, 3> fit_layer(std::span<const LevelVariance> finest_first, FitWeights weights) {
  std::array<BandFit, 3> fits;
  std::vector<BandVariance> band(finest_first.size());
  for (std::size_t t = 0; t < 3; ++t) {
    for (std::size_t n = 0; n < band.size(); ++n) band[n] = finest_first[n][t];
    fits[t] = fit_band(band, weights);
  }
  return fits;
}

LsaEnergy lsa_energy(const std::array<SigmaMap, 3>& maps) {
  constexpr std::size_t kBlock = 64;
  LsaEnergy energy;
  for (std::size_t t = 0; t < 3; ++t) {
    const SigmaMap& map = maps[t];
    assert(map.s0.size() == map.q.size());
    energy.count[t] = static_cast<std::int64_t>(map.s0.size());
    for (std::size_t from = 0; from < map.s0.size(); from += kBlock) {
      const std::size_t n = std::min(kBlock, map.s0.size() - from);
      std::array<double, kBlock> power{};
      std::array<double, kBlock> ratio{};
      for (std::size_t i = 0; i < n; ++i) {
        const double s0 = map.s0[from + i];
        const double q = map.q[from + i];
        power[i] = s0 * s0;
        ratio[i] = q * q;
      }
      for (std::size_t s = 0; s < static_cast<std::size_t>(kMaxDepth); ++s) {
        // Eight running sums, added up in a fixed order.
        std::array<double, 8> lanes{};
        for (std::size_t i = 0; i < kBlock; i += 8) {
          for (std::size_t lane = 0; lane < 8; ++lane) lanes[lane] += power[i + lane];
        }
        for (std::size_t i = 0; i < kBlock; ++i) power[i] *= ratio[i];
        energy.sum[t][s] +=
            ((lanes[0] + lanes[4]) + (lanes[2] + lanes[6])) + ((lanes[1] + lanes[5]) + (lanes[3] + lanes[7]));
      }
    }
  }
  return energy;
}

std::array<BandSigma, 3> band_sigmas(std::span<const BandFit, 3> fits, const LsaEnergy* energy,
                                     bool match_energy) {
  std::array<BandSigma, 3> bands;
  for (std::size_t t = 0; t < 3; ++t) {
    const BandFit& fit = fits[t];
    bands[t].s0 = fit.s0;
    bands[t].q = fit.q;
    bands[t].kappa.fill(1.0F);
    if (!match_energy || energy == nullptr || energy->count[t] == 0) continue;
    for (std::size_t s = 0; s < static_cast<std::size_t>(kMaxDepth); ++s) {
      const double mean = energy->sum[t][s] / static_cast<double>(energy->count[t]);
      if (!(mean > 0)) continue;
      const double target = fit.is_flat ? 0.0 : det::exp2(fit.a - fit.gamma * static_cast<double>(s));
      bands[t].kappa[s] = static_cast<float>(std::sqrt(target / mean));
    }
  }
  return bands;
}

}  // namespace lodestone
