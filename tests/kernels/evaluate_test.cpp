// Hold-out metrics on terrain whose answers are known, and the hold-out check of GSA and LSA on fractal
// terrain made here.

#include "kernels/synthesis/evaluate.h"

#include <gtest/gtest.h>

#include <cmath>
#include <random>

namespace lodestone {
namespace {

// Inverse of analyse() for worlds that start at post 0 and have an odd number of posts: y first, then x.
HeightGrid synthesise(const HeightGrid& coarse, const std::array<std::vector<float>, 3>& d) {
  const std::int64_t cw = coarse.window.width(), ch = coarse.window.height(), fw = 2 * cw - 1,
                     fh = 2 * ch - 1;
  const auto detail = [&](std::size_t t, std::int64_t i, std::int64_t j) {
    const std::int64_t x = t == 1 ? i : std::min(std::max<std::int64_t>(i, 0), cw - 2);
    const std::int64_t y = t == 0 ? j : std::min(std::max<std::int64_t>(j, 0), ch - 2);
    return d[t][static_cast<std::size_t>(y * cw + x)];
  };
  std::vector<float> lo(static_cast<std::size_t>(cw * fh)), hx(lo.size());
  const auto cell = [&](std::int64_t i, std::int64_t j) { return static_cast<std::size_t>(j * cw + i); };
  for (std::int64_t i = 0; i < cw; ++i) {
    for (std::int64_t j = 0; j < ch; ++j) {
      lo[cell(i, 2 * j)] = coarse.heights_m[cell(i, j)] - (detail(1, i, j - 1) + detail(1, i, j)) * 0.25F;
      hx[cell(i, 2 * j)] = detail(0, i, j) - (detail(2, i, j - 1) + detail(2, i, j)) * 0.25F;
    }
    for (std::int64_t j = 0; j + 1 < ch; ++j) {
      lo[cell(i, 2 * j + 1)] = detail(1, i, j) + (lo[cell(i, 2 * j)] + lo[cell(i, 2 * j + 2)]) * 0.5F;
      hx[cell(i, 2 * j + 1)] = detail(2, i, j) + (hx[cell(i, 2 * j)] + hx[cell(i, 2 * j + 2)]) * 0.5F;
    }
  }
  HeightGrid fine{{0, 0, fw - 1, fh - 1}, std::vector<float>(static_cast<std::size_t>(fw * fh)), {}};
  for (std::int64_t j = 0; j < fh; ++j) {
    float* out = fine.heights_m.data() + j * fw;
    for (std::int64_t i = 0; i < cw; ++i) {
      const float west = hx[cell(std::max<std::int64_t>(i - 1, 0), j)],
                  east = hx[cell(std::min(i, cw - 2), j)];
      out[2 * i] = lo[cell(i, j)] - (west + east) * 0.25F;
    }
    for (std::int64_t i = 0; i + 1 < cw; ++i)
      out[2 * i + 1] = hx[cell(i, j)] + (out[2 * i] + out[2 * i + 2]) * 0.5F;
  }
  return fine;
}

// Terrain by its own wavelet series: deviation sigma q^s at a cell, sigma changing smoothly by a factor of
// 2^contrast.
HeightGrid fractal(int levels, double roughness_h, double contrast, unsigned seed) {
  std::mt19937 random(seed);
  std::normal_distribution<double> g;
  HeightGrid grid{{0, 0, 4, 4}, {}, {}};
  for (int n = 0; n < 25; ++n) grid.heights_m.push_back(static_cast<float>(500 + 200 * g(random)));
  double sigma = 100;
  for (int level = 0; level < levels; ++level, sigma *= std::exp2(-roughness_h)) {
    const std::int64_t w = grid.window.width();
    std::array<std::vector<float>, 3> d;
    for (auto& band : d) {
      for (std::int64_t n = 0; n < w * w; ++n) {
        const double x = static_cast<double>(n % w) / static_cast<double>(w),
                     y = static_cast<double>(n / w) / static_cast<double>(w);
        const double local = std::exp2(contrast * std::sin(9 * x + 1) * std::cos(7 * y));
        band.push_back(static_cast<float>(sigma * local * g(random)));
      }
    }
    grid = synthesise(grid, d);
  }
  return grid;
}

LevelVariance variances_of(const AnalysisStep& step) {
  LevelVariance v{};
  for (std::size_t t = 0; t < 3; ++t) {
    for (std::size_t n = 0; n < step.detail_m[t].size(); ++n) {
      if (step.detail_void[t][n] != 0) continue;
      v[t].variance_m2 += static_cast<double>(step.detail_m[t][n]) * step.detail_m[t][n];
      ++v[t].count;
    }
    v[t].variance_m2 /= static_cast<double>(std::max<std::int64_t>(v[t].count, 1));
  }
  return v;
}

// Bilinear interpolation of a map at coefficient (X, Y) of the first new level but s (SPEC-SYNTHESIS 3.5).
double sigma_at(const SigmaMap& map, const std::vector<double>& value, std::size_t t, std::int64_t X,
                std::int64_t Y, int s) {
  const auto locate = [&](std::int64_t fine, double off, std::int64_t n, std::int64_t& at) {
    double u = (static_cast<double>(fine) / std::ldexp(1.0, s + 1) - off) / 2;
    u = std::min(std::max(u, 0.0), static_cast<double>(n - 1));
    at = std::min(static_cast<std::int64_t>(u), n - 2);
    return u - static_cast<double>(at);
  };
  std::int64_t i = 0, j = 0;
  const double fx = locate(X, t == 1 ? 0 : 1, map.width, i), fy = locate(Y, t == 0 ? 0 : 1, map.height, j);
  const auto v = [&](std::int64_t a, std::int64_t b) {
    return value[static_cast<std::size_t>(b * map.width + a)];
  };
  const double top = v(i, j) + fx * (v(i + 1, j) - v(i, j)),
               bottom = v(i, j + 1) + fx * (v(i + 1, j + 1) - v(i, j + 1));
  return top + fy * (bottom - top);
}

struct HoldOut {
  HoldOutMetrics gsa, lsa;
};

// k levels taken away, and put back by GSA and LSA.
HoldOut hold_out(const HeightGrid& real, int k, unsigned seed) {
  HeightGrid base = real;
  for (int level = 0; level < k; ++level) {
    AnalysisStep step = analyse(base, base.window, coarse_world(base.window));
    base = {step.coarse, step.low_m, step.low_void};
  }
  const LsaParameters parameters;
  std::vector<AnalysisStep> steps;
  std::vector<LevelVariance> variances;
  for (HeightGrid grid = base; grid.window.width() > 2;) {
    steps.push_back(analyse(grid, grid.window, coarse_world(grid.window)));
    variances.push_back(variances_of(steps.back()));
    grid = {steps.back().coarse, steps.back().low_m, steps.back().low_void};
  }
  const auto fits = fit_layer(variances, FitWeights::kWeighted);
  const auto maps =
      lsa_maps({0, 0, base.window.width(), base.window.height()}, base.window, steps, fits, parameters);
  const LsaEnergy energy = lsa_energy(maps);
  const auto bands = band_sigmas(fits, &energy, true);

  std::mt19937 random(seed);
  std::normal_distribution<double> g;
  HeightGrid with_gsa = base, with_lsa = base;
  for (int s = 0; s < k; ++s) {
    const std::int64_t w = with_gsa.window.width(), h = with_gsa.window.height();
    std::array<std::vector<float>, 3> gsa, lsa;
    for (std::size_t t = 0; t < 3; ++t) {
      std::vector<double> level_map;
      for (std::size_t n = 0; n < maps[t].s0.size(); ++n) {
        level_map.push_back(maps[t].s0[n] * std::pow(static_cast<double>(maps[t].q[n]), s) *
                            bands[t].kappa[static_cast<std::size_t>(s)]);
      }
      for (std::int64_t n = 0; n < w * h; ++n) {
        const double noise = g(random);
        const std::int64_t X = 2 * (n % w) + (t == 1 ? 0 : 1), Y = 2 * (n / w) + (t == 0 ? 0 : 1);
        gsa[t].push_back(
            static_cast<float>(noise * fits[t].s0 * std::pow(static_cast<double>(fits[t].q), s)));
        lsa[t].push_back(static_cast<float>(noise * sigma_at(maps[t], level_map, t, X, Y, s)));
      }
    }
    with_gsa = synthesise(with_gsa, gsa);
    with_lsa = synthesise(with_lsa, lsa);
  }
  return {compare_levels(real, with_gsa, k), compare_levels(real, with_lsa, k)};
}

TEST(CompareLevels, OfATerrainWithItselfIsPerfect) {
  const HeightGrid real = fractal(5, 0.7, 1, 3);
  const HoldOutMetrics m = compare_levels(real, real, 2);
  EXPECT_EQ(m.band_rms, 0);
  EXPECT_NEAR(m.rough_corr, 1, 1e-12);
  EXPECT_EQ(m.slope_real, m.slope_synthetic);
  EXPECT_EQ(m.kurtosis_real, m.kurtosis_synthetic);
  EXPECT_EQ(m.log2_variance_ratio.size(), 2U);
}

TEST(CompareLevels, SeesTwiceTheHeightAsFourTimesTheVariance) {
  const HeightGrid real = fractal(5, 0.7, 1, 4);
  HeightGrid twice = real;
  for (float& h : twice.heights_m) h *= 2;
  const HoldOutMetrics m = compare_levels(real, twice, 2);
  EXPECT_NEAR(m.band_rms, 2, 1e-9);
  for (const auto& level : m.log2_variance_ratio) {
    for (const double ratio : level) EXPECT_NEAR(ratio, 2, 1e-9);
  }
  EXPECT_NEAR(m.rough_corr, 1, 1e-9);
  EXPECT_NEAR(m.slope_real, m.slope_synthetic, 1e-9);
}

// White noise has a flat spectrum; its running sum along both axes falls with 2 on the axes, so only the
// white one is stated.
TEST(CompareLevels, MeasuresAFlatSpectrumAndAGaussianKurtosisOfNoise) {
  std::mt19937 random(8);
  std::normal_distribution<float> g;
  HeightGrid noise{{0, 0, 256, 256}, {}, {}};
  for (int n = 0; n < 257 * 257; ++n) noise.heights_m.push_back(g(random));
  const HoldOutMetrics m = compare_levels(noise, noise, 2);
  EXPECT_NEAR(m.slope_real, 0, 0.1);
  EXPECT_NEAR(m.kurtosis_real, 3, 5 * std::sqrt(24.0 / 16384) + 0.05);
}

// A cosine sum with the amplitudes of a power law: the slope comes back.
TEST(CompareLevels, MeasuresTheSlopeOfAPowerLaw) {
  constexpr int kSize = 256;
  std::mt19937 random(9);
  std::normal_distribution<double> g;
  // Separable random phases on integer wave numbers: f(x, y) = sum of a(k) cos(2 pi (kx x + ky y) / 256 +
  // phase).
  HeightGrid grid{{0, 0, kSize - 1, kSize - 1}, std::vector<float>(kSize * kSize), {}};
  std::vector<double> cosine(kSize), height(kSize * kSize);
  for (int i = 0; i < kSize; ++i) cosine[static_cast<std::size_t>(i)] = std::cos(2 * M_PI * i / kSize);
  for (int kx = -120; kx <= 120; kx += 3) {
    for (int ky = 0; ky <= 120; ky += 3) {
      const double r = std::hypot(kx, ky);
      if (r < 6) continue;
      const double a = 1e3 * std::pow(r, -1.7) * std::abs(1 + 0.3 * g(random));  // power ~ r^-3.4: H = 0.7
      const int phase = static_cast<int>(random() % kSize);
      for (int y = 0; y < kSize; ++y) {
        for (int x = 0; x < kSize; ++x) {
          height[static_cast<std::size_t>(y * kSize + x)] +=
              a * cosine[static_cast<std::size_t>((kx * x + ky * y + phase) & (kSize - 1))];
        }
      }
    }
  }
  for (std::size_t n = 0; n < height.size(); ++n) grid.heights_m[n] = static_cast<float>(height[n]);
  EXPECT_NEAR(compare_levels(grid, grid, 2).slope_real, -3.4, 0.2);
}

TEST(CompareLevels, LeavesVoidPostsOut) {
  const HeightGrid real = fractal(5, 0.7, 1, 5);
  HeightGrid holed = real;
  holed.is_void.assign(holed.heights_m.size(), 0);
  for (std::int64_t j = 20; j < 50; ++j) {
    for (std::int64_t i = 10; i < 60; ++i) {
      holed.is_void[holed.index(i, j)] = 1;
      holed.heights_m[holed.index(i, j)] = 9000.0F + static_cast<float>((i * 37 + j * 11) % 500);
    }
  }
  const HoldOutMetrics m = compare_levels(real, holed, 2);
  EXPECT_EQ(m.band_rms, 0);
  EXPECT_NEAR(m.rough_corr, 1, 1e-12);
  EXPECT_EQ(m.slope_real, m.slope_synthetic);
}

TEST(CompareLevels, IsFiniteOnDegenerateGrids) {
  for (const PostWindow w :
       {PostWindow{0, 0, 0, 0}, {0, 0, 1, 1}, {0, 0, 0, 40}, {3, 5, 12, 30}, {0, 0, 40, 40}}) {
    for (const int kind : {0, 1, 2}) {  // flat, all void, flat against rough
      HeightGrid real{w, std::vector<float>(static_cast<std::size_t>(w.width() * w.height()), 7.0F), {}};
      if (kind == 1) real.is_void.assign(real.heights_m.size(), 1);
      HeightGrid other = real;
      if (kind == 2) {
        for (std::size_t n = 0; n < other.heights_m.size(); ++n)
          other.heights_m[n] = static_cast<float>(n * n % 17);
      }
      const HoldOutMetrics m = compare_levels(real, other, 3);
      for (const double v : {m.band_rms, m.rough_corr, m.slope_real, m.slope_synthetic, m.kurtosis_real,
                             m.kurtosis_synthetic}) {
        EXPECT_TRUE(std::isfinite(v)) << kind << ' ' << w.width() << 'x' << w.height();
      }
      if (kind < 2) {
        EXPECT_EQ(m.band_rms, 0);
      }
    }
  }
}

class HoldOutCheck : public testing::TestWithParam<unsigned> {};

TEST_P(HoldOutCheck, LsaPutsRoughnessWhereItWasAndBothKeepThePowerLaw) {
  const HeightGrid real = fractal(7, 0.4 + 0.1 * GetParam(), 2.0, 100 + GetParam());
  for (const int k : {1, 2}) {
    const HoldOut h = hold_out(real, k, 7 * GetParam() + 1);
    EXPECT_GE(h.lsa.rough_corr, k == 1 ? 0.80 : 0.65) << k;
    EXPECT_LE(std::abs(h.gsa.rough_corr), 0.15) << k;
    EXPECT_LE(h.lsa.band_rms, k == 1 ? 0.75 : 1.35) << k;
    EXPECT_LE(h.gsa.band_rms, k == 1 ? 0.75 : 1.35) << k;
    EXPECT_NEAR(h.lsa.slope_synthetic, h.lsa.slope_real, 0.4) << k;
    EXPECT_NEAR(h.gsa.kurtosis_synthetic, 3, 5 * std::sqrt(24.0 / 65536) + 0.05) << k;
    EXPECT_GT(h.lsa.kurtosis_synthetic, 3.5) << k;  // a mixture of deviations, as the real one
  }
}

INSTANTIATE_TEST_SUITE_P(Terrains, HoldOutCheck, testing::Values(1U, 2U, 3U, 4U));

// Posts of the first k levels survive: analysing the synthesis gives the data back, whatever the details.
TEST(Analysis, UndoesTheSynthesis) {
  std::mt19937 random(2);
  std::normal_distribution<float> g(0, 20);
  HeightGrid coarse{{0, 0, 16, 16}, {}, {}};
  for (int n = 0; n < 289; ++n) coarse.heights_m.push_back(500 + g(random));
  std::array<std::vector<float>, 3> d;
  for (auto& band : d) {
    for (int n = 0; n < 289; ++n) band.push_back(g(random));
  }
  const HeightGrid fine = synthesise(coarse, d);
  const AnalysisStep step = analyse(fine, fine.window, coarse_world(fine.window));
  for (std::size_t n = 0; n < 289; ++n) EXPECT_NEAR(step.low_m[n], coarse.heights_m[n], 2 * 0x1p-21 * 700);
  for (std::size_t t = 0; t < 3; ++t) {
    for (std::size_t n = 0; n < 289; ++n) {
      if (step.detail_void[t][n] == 0) {
        EXPECT_NEAR(step.detail_m[t][n], d[t][n], 1e-3);
      }
    }
  }
}

}  // namespace
}  // namespace lodestone
