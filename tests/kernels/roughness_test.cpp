// The power law of GSA and the maps of LSA against the specification's numbers, a plain twin, and their own
// crops.

#include "kernels/synthesis/roughness.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <random>

namespace lodestone {
namespace {

using testing::ElementsAre;

HeightGrid noise(const PostWindow& window, unsigned seed, double void_share = 0) {
  HeightGrid grid{window, {}, {}};
  std::mt19937 random(seed);
  std::normal_distribution<float> height(300.0F, 40.0F);
  const auto n = static_cast<std::size_t>(window.width() * window.height());
  for (std::size_t k = 0; k < n; ++k) grid.heights_m.push_back(height(random));
  if (void_share > 0) {
    std::bernoulli_distribution is_void(void_share);
    for (std::size_t k = 0; k < n; ++k) grid.is_void.push_back(is_void(random) ? 1 : 0);
  }
  return grid;
}

HeightGrid crop(const HeightGrid& whole, const PostWindow& w) {
  HeightGrid grid{w, {}, {}};
  for (std::int64_t j = w.j0; j <= w.j1; ++j) {
    for (std::int64_t i = w.i0; i <= w.i1; ++i) {
      grid.heights_m.push_back(whole.at(i, j));
      if (!whole.is_void.empty()) grid.is_void.push_back(whole.void_at(i, j) ? 1 : 0);
    }
  }
  return grid;
}

// -------- logarithm and power

TEST(DeterministicMath, AgreesWithTheLibraryToFourteenDigits) {
  std::mt19937_64 random(1);
  std::uniform_real_distribution<double> exponent(-990, 990), near_one(0.5, 2.0);
  double worst_log = 0, worst_exp = 0;
  for (int n = 0; n < 400000; ++n) {
    const double e = exponent(random);
    const double x = n % 2 == 0 ? std::exp2(e) : near_one(random);
    const long double log = std::log2(static_cast<long double>(x));
    if (log != 0) worst_log = std::max(worst_log, static_cast<double>(std::abs((det_log2(x) - log) / log)));
    const double p = n % 2 == 0 ? e : x - 1;
    const long double power = std::exp2(static_cast<long double>(p));
    worst_exp = std::max(worst_exp, static_cast<double>(std::abs((det_exp2(p) - power) / power)));
  }
  EXPECT_LT(worst_log, 1e-14);
  EXPECT_LT(worst_exp, 1e-14);
}

TEST(DeterministicMath, IsExactAtPowersOfTwo) {
  for (int k = -999; k <= 999; ++k) {
    EXPECT_EQ(det_exp2(k), std::ldexp(1.0, k));
    EXPECT_EQ(det_log2(std::ldexp(1.0, k)), k);
  }
  EXPECT_NEAR(det_log2(1 + 0x1p-50), 0x1p-50 / std::log(2.0), 0x1p-50 * 1e-13);
}

// -------- fit

struct FitCase {
  std::vector<double> variances;
  std::vector<std::int64_t> counts;
  FitWeights weights;
  double a, gamma;
  bool is_clamped;
};

class FitVectors : public testing::TestWithParam<FitCase> {};

TEST_P(FitVectors, AreThoseOfTheSpecification) {
  const FitCase& c = GetParam();
  std::vector<BandVariance> levels;
  for (std::size_t n = 0; n < c.variances.size(); ++n) levels.push_back({c.variances[n], c.counts[n]});
  const BandFit fit = fit_band(levels, c.weights);
  EXPECT_NEAR(fit.a, c.a, 1e-6);
  EXPECT_NEAR(fit.gamma, c.gamma, 1e-6);
  EXPECT_EQ(fit.is_clamped, c.is_clamped);
  EXPECT_FALSE(fit.is_flat);
  EXPECT_NEAR(fit.s0, std::exp2(fit.a / 2), 1e-6 * fit.s0);
  EXPECT_NEAR(fit.q, std::exp2(-fit.gamma / 2), 1e-7);
}

INSTANTIATE_TEST_SUITE_P(
    Spec, FitVectors,
    testing::Values(
        FitCase{{4, 9, 30, 70}, {4096, 1024, 256, 64}, FitWeights::kWeighted, 0.641446, 1.338864, false},
        FitCase{{4, 9, 30, 70}, {4096, 1024, 256, 64}, FitWeights::kPaper, 0.520321, 1.412481, false},
        FitCase{{4, 9, 30, 70}, {64, 16, 4, 1}, FitWeights::kWeighted, 0.830075, 1.169925, false},
        FitCase{{4, 9, 30, 70}, {64, 16, 4, 1}, FitWeights::kPaper, 0.830075, 1.169925, false},
        FitCase{{1, 40, 900}, {4096, 1024, 256}, FitWeights::kWeighted, -3.661834, 4, true},
        FitCase{{8, 2, 1}, {4096, 1024, 256}, FitWeights::kWeighted, 2.219048, 0.2, true}));

TEST(Fit, GoesThroughTheFinestLevelWhereFewerThanTwoAreUsable) {
  const std::vector<BandVariance> levels{{8, 9}, {100, 4}};
  const BandFit fit = fit_band(levels, FitWeights::kWeighted);
  EXPECT_DOUBLE_EQ(fit.gamma, 1.6);
  EXPECT_DOUBLE_EQ(fit.a, 3 - 1.6);
  EXPECT_EQ(fit.levels_used, 0);
}

TEST(Fit, OfFlatOrMissingTerrainIsFlatAndFinite) {
  for (const auto& levels :
       {std::vector<BandVariance>{}, {{0, 4096}, {5, 1024}}, {{0x1p-40, 64}}, {{0, 0}}}) {
    const BandFit fit = fit_band(levels, FitWeights::kWeighted);
    EXPECT_TRUE(fit.is_flat);
    EXPECT_EQ(fit.s0, 0);
    EXPECT_TRUE(std::isfinite(fit.q) && std::isfinite(fit.a) && std::isfinite(fit.gamma));
  }
}

TEST(Fit, OfALayerIsTheFitOfEachBand) {
  std::vector<LevelVariance> levels(3);
  for (std::size_t n = 0; n < 3; ++n) {
    for (std::size_t t = 0; t < 3; ++t)
      levels[n][t] = {std::pow(2.0, 1.0 + static_cast<double>(n * (t + 1))), 4096 >> (2 * n)};
  }
  const auto fits = fit_layer(levels, FitWeights::kWeighted);
  for (std::size_t t = 0; t < 3; ++t) EXPECT_NEAR(fits[t].gamma, static_cast<double>(t + 1), 1e-12);
}

// -------- analysis

TEST(Analysis, OfTheSpecificationsGridGivesItsNumbers) {
  const HeightGrid h5{{0, 0, 4, 4},
                      {100, 104, 112, 108, 96,  102, 110, 120, 114, 100, 98,  107, 125,
                       119, 104, 95,  101, 116, 111, 99,  90,  97,  108, 103, 94},
                      {}};
  const AnalysisStep step = analyse(h5, h5.window, coarse_world(h5.window));
  EXPECT_EQ(step.coarse, (PostWindow{0, 0, 2, 2}));
  EXPECT_THAT(step.low_m, ElementsAre(101.0625F, 113.5F, 97.9375F, 96.875F, 125.3125F, 106.25F, 89.1875F,
                                      107.625F, 95.0625F));
  EXPECT_THAT(step.detail_m[0], ElementsAre(-0.875F, 3.875F, 0, -4.25F, 4.5F, 0, -2.625F, 2.125F, 0));
  EXPECT_THAT(step.detail_m[1], ElementsAre(4.125F, 2, -0.125F, 0.375F, -0.75F, 0.125F, 0, 0, 0));
  EXPECT_THAT(step.detail_m[2], ElementsAre(2.25F, -0.25F, 0, -1.25F, 0.25F, 0, 0, 0, 0));
  EXPECT_THAT(step.detail_void[0], ElementsAre(0, 0, 1, 0, 0, 1, 0, 0, 1));
  EXPECT_THAT(step.detail_void[1], ElementsAre(0, 0, 0, 0, 0, 0, 1, 1, 1));
  EXPECT_THAT(step.detail_void[2], ElementsAre(0, 0, 1, 0, 0, 1, 1, 1, 1));
  EXPECT_TRUE(step.low_void.empty());
}

// The filters written as taps, in double, on a mirror that repeats for ever.
double filtered(const HeightGrid& g, const PostWindow& world, std::int64_t x, std::int64_t y, bool high_x,
                bool high_y, bool& is_void) {
  const auto mirror = [](std::int64_t i, std::int64_t lo, std::int64_t hi) {
    const std::int64_t period = 2 * (hi - lo);
    if (period == 0) return lo;
    const std::int64_t r = ((i - lo) % period + period) % period;
    return lo + (r > hi - lo ? period - r : r);
  };
  const auto taps = [](bool high) {
    return high ? std::vector<double>{-0.5, 1, -0.5} : std::vector<double>{-0.125, 0.25, 0.75, 0.25, -0.125};
  };
  const auto tx = taps(high_x), ty = taps(high_y);
  double sum = 0;
  for (std::size_t b = 0; b < ty.size(); ++b) {
    for (std::size_t a = 0; a < tx.size(); ++a) {
      const auto i = mirror(x + static_cast<std::int64_t>(a) - static_cast<std::int64_t>(tx.size() / 2),
                            world.i0, world.i1);
      const auto j = mirror(y + static_cast<std::int64_t>(b) - static_cast<std::int64_t>(ty.size() / 2),
                            world.j0, world.j1);
      sum += tx[a] * ty[b] * g.at(i, j);
      is_void = is_void || g.void_at(i, j);
    }
  }
  return sum;
}

struct World {
  PostWindow window;
  double void_share = 0;
};

class AnalysisOfWorlds : public testing::TestWithParam<World> {};

TEST_P(AnalysisOfWorlds, IsTheFilterBankWithMirroredBorders) {
  const PostWindow world = GetParam().window;
  const HeightGrid fine = noise(world, 5, GetParam().void_share);
  const AnalysisStep step = analyse(fine, world, coarse_world(world));
  for (std::int64_t j = step.coarse.j0; j <= step.coarse.j1; ++j) {
    for (std::int64_t i = step.coarse.i0; i <= step.coarse.i1; ++i) {
      const auto at =
          static_cast<std::size_t>((j - step.coarse.j0) * step.coarse.width() + i - step.coarse.i0);
      bool is_void = false;
      EXPECT_NEAR(step.low_m[at], filtered(fine, world, 2 * i, 2 * j, false, false, is_void), 1e-3)
          << i << ' ' << j;
      EXPECT_EQ(!step.low_void.empty() && step.low_void[at] != 0, is_void) << i << ' ' << j;
      for (std::size_t t = 0; t < 3; ++t) {
        const bool hx = t != 1, hy = t != 0;
        const std::int64_t x = 2 * i + (hx ? 1 : 0), y = 2 * j + (hy ? 1 : 0);
        if (!world.contains(x, y)) {
          EXPECT_EQ(step.detail_m[t][at], 0);
          EXPECT_EQ(step.detail_void[t][at], 1);
          continue;
        }
        bool detail_void = false;
        EXPECT_NEAR(step.detail_m[t][at], filtered(fine, world, x, y, hx, hy, detail_void), 1e-3)
            << t << ' ' << i << ' ' << j;
        EXPECT_EQ(step.detail_void[t][at] != 0, detail_void) << t << ' ' << i << ' ' << j;
      }
    }
  }
}

TEST_P(AnalysisOfWorlds, ByRectanglesIsTheCropBitForBit) {
  const PostWindow world = GetParam().window;
  const HeightGrid fine = noise(world, 6, GetParam().void_share);
  const PostWindow all = coarse_world(world);
  const AnalysisStep whole = analyse(fine, world, all);
  std::mt19937 random(7);
  for (int round = 0; round < 40; ++round) {
    const auto pick = [&](std::int64_t lo, std::int64_t hi) {
      return std::uniform_int_distribution<std::int64_t>(lo, hi)(random);
    };
    PostWindow r;
    r.i0 = pick(all.i0, all.i1);
    r.i1 = pick(r.i0, all.i1);
    r.j0 = pick(all.j0, all.j1);
    r.j1 = pick(r.j0, all.j1);
    const AnalysisStep part = analyse(crop(fine, analysis_window(r, world)), world, r);
    for (std::int64_t j = r.j0; j <= r.j1; ++j) {
      for (std::int64_t i = r.i0; i <= r.i1; ++i) {
        const auto p = static_cast<std::size_t>((j - r.j0) * r.width() + i - r.i0);
        const auto w = static_cast<std::size_t>((j - all.j0) * all.width() + i - all.i0);
        ASSERT_EQ(std::memcmp(&part.low_m[p], &whole.low_m[w], 4), 0) << i << ' ' << j;
        ASSERT_EQ(!part.low_void.empty() && part.low_void[p] != 0,
                  !whole.low_void.empty() && whole.low_void[w] != 0);
        for (std::size_t t = 0; t < 3; ++t) {
          ASSERT_EQ(std::memcmp(&part.detail_m[t][p], &whole.detail_m[t][w], 4), 0)
              << t << ' ' << i << ' ' << j;
          ASSERT_EQ(part.detail_void[t][p], whole.detail_void[t][w]);
        }
      }
    }
  }
}

INSTANTIATE_TEST_SUITE_P(Sizes, AnalysisOfWorlds,
                         testing::Values(World{{0, 0, 16, 16}}, World{{0, 0, 17, 20}, 0.03},
                                         World{{3, 5, 20, 32}}, World{{-7, 4, 8, 19}, 0.05},
                                         World{{0, 0, 0, 0}}, World{{1, 1, 1, 1}}, World{{0, 0, 1, 1}},
                                         World{{1, 3, 2, 4}}, World{{0, 0, 0, 13}}, World{{5, 0, 5, 12}},
                                         World{{4, 7, 23, 7}, 0.1}, World{{3, 0, 5, 2}},
                                         World{{0, 0, 9, 9}, 1.0}));

// -------- LSA

std::vector<AnalysisStep> whole_steps(const HeightGrid& base, int levels) {
  std::vector<AnalysisStep> steps;
  HeightGrid grid = base;
  for (int l = 0; l < levels; ++l) {
    steps.push_back(analyse(grid, grid.window, coarse_world(grid.window)));
    grid = {steps.back().coarse, steps.back().low_m, steps.back().low_void};
  }
  return steps;
}

LevelVariance variances_of(const AnalysisStep& step) {
  LevelVariance result{};
  for (std::size_t t = 0; t < 3; ++t) {
    for (std::size_t n = 0; n < step.detail_m[t].size(); ++n) {
      if (step.detail_void[t][n] != 0) continue;
      result[t].variance_m2 += static_cast<double>(step.detail_m[t][n]) * step.detail_m[t][n];
      ++result[t].count;
    }
    if (result[t].count > 0) result[t].variance_m2 /= static_cast<double>(result[t].count);
  }
  return result;
}

std::array<BandFit, 3> fits_of(const std::vector<AnalysisStep>& steps) {
  std::vector<LevelVariance> levels;
  for (const auto& step : steps) levels.push_back(variances_of(step));
  return fit_layer(levels, FitWeights::kWeighted);
}

PostWindow whole_map(const PostWindow& world) {
  return {0, 0, (world.width() + 1) / 2, (world.height() + 1) / 2};
}

struct Lsa {
  PostWindow world;
  int window;
  int levels;
  double void_share = 0;
};

class LsaMaps : public testing::TestWithParam<Lsa> {
 protected:
  LsaParameters parameters() const {
    LsaParameters p;
    p.window = GetParam().window;
    p.levels = GetParam().levels;
    p.trust = 0.4;
    return p;
  }
};

TEST_P(LsaMaps, FollowTheTextEntryByEntry) {
  const PostWindow world = GetParam().world;
  const HeightGrid base = noise(world, 11, GetParam().void_share);
  const auto steps = whole_steps(base, 6);
  const auto fits = fits_of(steps);
  const LsaParameters p = parameters();
  const auto maps = lsa_maps(whole_map(world), world, steps, fits, p);
  const double bias = p.window == 1   ? 1.832746
                      : p.window == 3 ? 0.166208
                      : p.window == 5 ? 0.058477
                                      : 0.029643;
  for (std::size_t t = 0; t < 3; ++t) {
    const bool hx = t != 1, hy = t != 0;
    const SigmaMap& map = maps[t];
    ASSERT_EQ(map.s0.size(), static_cast<std::size_t>(map.map_width * map.map_height));
    for (std::int64_t J = 0; J < map.map_height; ++J) {
      for (std::int64_t I = 0; I < map.map_width; ++I) {
        std::vector<double> xs, ys;
        PostWindow fine = world;
        for (int l = 1; l <= p.levels; ++l, fine = coarse_world(fine)) {
          // Coefficients whose fine post exists and whose coarse post is in the pyramid.
          const PostWindow coarse = coarse_world(fine);
          std::int64_t x0 = coarse.i0, x1 = coarse.i1, y0 = coarse.j0, y1 = coarse.j1;
          while (x1 >= x0 && 2 * x1 + (hx ? 1 : 0) > fine.i1) --x1;
          while (y1 >= y0 && 2 * y1 + (hy ? 1 : 0) > fine.j1) --y1;
          while (x0 <= x1 && 2 * x0 < fine.i0) ++x0;
          while (y0 <= y1 && 2 * y0 < fine.j0) ++y0;
          if (x1 - x0 + 1 < p.window || y1 - y0 + 1 < p.window) continue;
          const double x = static_cast<double>(world.i0 + 2 * I + (hx ? 1 : 0)),
                       y = static_cast<double>(world.j0 + 2 * J + (hy ? 1 : 0));
          const double step = std::ldexp(1.0, l);
          const auto cx = static_cast<std::int64_t>(std::floor(x / step + (hx ? 0 : 0.5)));
          const auto cy = static_cast<std::int64_t>(std::floor(y / step + (hy ? 0 : 0.5)));
          const std::int64_t sx = std::min(std::max(cx - p.window / 2, x0), x1 - p.window + 1);
          const std::int64_t sy = std::min(std::max(cy - p.window / 2, y0), y1 - p.window + 1);
          double sum = 0;
          int n = 0;
          for (std::int64_t b = sy; b < sy + p.window; ++b) {
            for (std::int64_t a = sx; a < sx + p.window; ++a) {
              const auto& s = steps[static_cast<std::size_t>(l - 1)];
              const auto at =
                  static_cast<std::size_t>((b - s.coarse.j0) * s.coarse.width() + a - s.coarse.i0);
              if (s.detail_void[t][at] != 0) continue;
              sum += std::pow(static_cast<double>(s.detail_m[t][at]), 2);
              ++n;
            }
          }
          if (2 * n < p.window * p.window) continue;
          xs.push_back(-l);
          ys.push_back(std::log2(sum / n) + bias);
        }
        double a = fits[t].a, gamma = fits[t].gamma;
        if (!xs.empty()) {
          double mx = 0, my = 0, sxx = 0, sxy = 0;
          for (std::size_t k = 0; k < xs.size(); ++k)
            mx += xs[k] / static_cast<double>(xs.size()), my += ys[k] / static_cast<double>(xs.size());
          for (std::size_t k = 0; k < xs.size(); ++k)
            sxx += (xs[k] - mx) * (xs[k] - mx), sxy += (xs[k] - mx) * (ys[k] - my);
          if (xs.size() > 1) gamma = std::clamp(p.trust * (-sxy / sxx) + (1 - p.trust) * gamma, 0.2, 4.0);
          a = my + gamma * mx;
        }
        const auto at = static_cast<std::size_t>(J * map.width + I);
        const double s0 = xs.empty() && fits[t].is_flat ? 0.0 : std::exp2(a / 2), q = std::exp2(-gamma / 2);
        ASSERT_NEAR(map.s0[at], s0, 1e-6 * s0) << t << ' ' << I << ' ' << J << " levels " << xs.size();
        ASSERT_NEAR(map.q[at], q, 1e-6 * q) << t << ' ' << I << ' ' << J;
      }
    }
  }
}

TEST_P(LsaMaps, ByRectanglesAreTheCropBitForBit) {
  const PostWindow world = GetParam().world;
  const HeightGrid base = noise(world, 12, GetParam().void_share);
  const LsaParameters p = parameters();
  const auto whole = whole_steps(base, p.levels);
  const auto fits = fits_of(whole);
  const auto all = lsa_maps(whole_map(world), world, whole, fits, p);
  std::mt19937 random(13);
  const auto pick = [&](std::int64_t lo, std::int64_t hi) {
    return std::uniform_int_distribution<std::int64_t>(lo, hi)(random);
  };
  for (int round = 0; round < 25; ++round) {
    PostWindow r;
    r.i0 = pick(0, (world.width() - 1) / 2);
    r.i1 = pick(r.i0, world.width() / 2);
    r.j0 = pick(0, (world.height() - 1) / 2);
    r.j1 = pick(r.j0, world.height() / 2);
    // Only what lsa_needs() asks for, each level from its own rectangle.
    const auto needs = lsa_needs(r, world, p);
    std::vector<AnalysisStep> steps;
    HeightGrid level = base;
    for (std::size_t l = 0; l < needs.size(); ++l) {
      steps.push_back(analyse(crop(level, analysis_window(needs[l], level.window)), level.window, needs[l]));
      level = {whole[l].coarse, whole[l].low_m, whole[l].low_void};
    }
    const auto part = lsa_maps(r, world, steps, fits, p);
    for (std::size_t t = 0; t < 3; ++t) {
      for (std::int64_t J = 0; J < part[t].height; ++J) {
        for (std::int64_t I = 0; I < part[t].width; ++I) {
          const auto at = static_cast<std::size_t>(J * part[t].width + I);
          const auto of = static_cast<std::size_t>((part[t].j0 + J) * all[t].width + part[t].i0 + I);
          ASSERT_EQ(std::memcmp(&part[t].s0[at], &all[t].s0[of], 4), 0) << t << ' ' << I << ' ' << J;
          ASSERT_EQ(std::memcmp(&part[t].q[at], &all[t].q[of], 4), 0) << t << ' ' << I << ' ' << J;
        }
      }
    }
  }
}

INSTANTIATE_TEST_SUITE_P(Worlds, LsaMaps,
                         testing::Values(Lsa{{0, 0, 64, 64}, 3, 3}, Lsa{{0, 0, 150, 43}, 3, 3},
                                         Lsa{{0, 0, 61, 90}, 5, 3, 0.01}, Lsa{{6, 10, 77, 61}, 7, 2},
                                         Lsa{{-2, 2, 50, 33}, 1, 4, 0.02}, Lsa{{0, 0, 40, 40}, 3, 6, 0.04},
                                         Lsa{{0, 0, 6, 6}, 3, 3}, Lsa{{0, 0, 1, 1}, 3, 3},
                                         Lsa{{0, 0, 0, 0}, 1, 3}, Lsa{{0, 0, 0, 30}, 1, 3},
                                         Lsa{{0, 0, 30, 1}, 3, 3}, Lsa{{0, 0, 20, 20}, 3, 3, 1.0}));

// Rough on the left, a lake on the right.
TEST(LsaMap, KeepsALakeFlatAndFinite) {
  HeightGrid base = noise({0, 0, 64, 64}, 21);
  for (std::int64_t j = 0; j <= 64; ++j) {
    for (std::int64_t i = 32; i <= 64; ++i) base.heights_m[base.index(i, j)] = 211.25F;
  }
  const auto steps = whole_steps(base, 3);
  const auto fits = fits_of(whole_steps(base, 6));
  const auto maps = lsa_maps(whole_map(base.window), base.window, steps, fits, {});
  for (std::size_t t = 0; t < 3; ++t) {
    for (std::int64_t J = 0; J < maps[t].height; ++J) {
      for (std::int64_t I = 0; I < maps[t].width; ++I) {
        const auto at = static_cast<std::size_t>(J * maps[t].width + I);
        ASSERT_TRUE(std::isfinite(maps[t].s0[at]) && std::isfinite(maps[t].q[at]));
        if (I >= 18) {
          EXPECT_EQ(maps[t].s0[at], 0) << t << ' ' << I;
        }
        if (I <= 14) {
          EXPECT_GT(maps[t].s0[at], 0) << t << ' ' << I;
        }
      }
    }
  }
}

TEST(LsaMap, OfFlatTerrainIsZero) {
  HeightGrid base = noise({0, 0, 32, 32}, 1);
  std::fill(base.heights_m.begin(), base.heights_m.end(), 1234.5F);
  const auto steps = whole_steps(base, 3);
  const auto fits = fits_of(steps);
  const auto maps = lsa_maps(whole_map(base.window), base.window, steps, fits, {});
  const LsaEnergy energy = lsa_energy(maps);
  for (const BandSigma& band : band_sigmas(fits, &energy, true)) {
    EXPECT_EQ(band.s0, 0);
    EXPECT_THAT(band.kappa, testing::Each(1.0F));
  }
  for (const SigmaMap& map : maps) EXPECT_THAT(map.s0, testing::Each(0.0F));
}

TEST(LsaEnergy, MatchedGivesTheEnergyOfTheFit) {
  const HeightGrid base = noise({0, 0, 90, 70}, 31);
  const auto steps = whole_steps(base, 3);
  const auto fits = fits_of(steps);
  const auto maps = lsa_maps(whole_map(base.window), base.window, steps, fits, {});
  const LsaEnergy energy = lsa_energy(maps);
  const auto bands = band_sigmas(fits, &energy, true);
  for (std::size_t t = 0; t < 3; ++t) {
    EXPECT_EQ(energy.count[t], maps[t].map_width * maps[t].map_height);
    for (std::size_t s = 0; s < static_cast<std::size_t>(kMaxDepth); ++s) {
      double sum = 0;
      for (std::size_t n = 0; n < maps[t].s0.size(); ++n) {
        const double sigma = maps[t].s0[n] *
                             std::pow(static_cast<double>(maps[t].q[n]), static_cast<double>(s)) *
                             bands[t].kappa[s];
        sum += sigma * sigma;
      }
      const double expected = std::exp2(fits[t].a - fits[t].gamma * static_cast<double>(s));
      EXPECT_NEAR(sum / static_cast<double>(maps[t].s0.size()), expected, 1e-5 * expected) << t << ' ' << s;
    }
  }
  EXPECT_THAT(band_sigmas(fits, &energy, false)[0].kappa, testing::Each(1.0F));
  EXPECT_THAT(band_sigmas(fits, nullptr, true)[0].kappa, testing::Each(1.0F));
  EXPECT_EQ(bands[1].s0, fits[1].s0);
  EXPECT_EQ(bands[1].q, fits[1].q);
}

}  // namespace
}  // namespace lodestone
