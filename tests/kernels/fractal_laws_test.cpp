// Laws and known answers of midpoint displacement and the fractal wavelet.

#include <gtest/gtest.h>

#include <cmath>
#include <random>

#include "kernels/fractal/fractal_synthesis.h"
#include "kernels/fractal/fractal_wavelet.h"
#include "tests/support/fractal_reference.h"

namespace lodestone {
namespace {

using testing::FractalWorld;

// All nodes alike.
FractalWorld even_world(std::int64_t posts, float height_m, NodeRoughness node) {
  FractalWorld w = testing::random_fractal_world(1, posts, posts, 4);
  std::fill(w.heights.begin(), w.heights.end(), height_m);
  std::fill(w.nodes.nodes.begin(), w.nodes.nodes.end(), node);
  return w;
}

std::vector<float> synthesise(const FractalWorld& world, FractalTask task) {
  world.fill(task);
  std::vector<std::vector<float>> out(1);
  Result<void> done = make_host_fractal_synthesis()->run({&task, 1}, out);
  EXPECT_TRUE(done) << done.error().message;
  return out[0];
}

FractalTask whole_task(FractalMethod method, int depth, std::int64_t posts) {
  FractalTask t;
  t.method = method;
  t.depth = depth;
  t.posts = static_cast<int>(((posts - 1) << depth) + 1);
  t.seed = 0x0123456789abcdefull;
  t.base_level = 5;
  return t;
}

constexpr FractalMethod kMethods[] = {FractalMethod::kSquareSquare, FractalMethod::kDiamondSquare,
                                      FractalMethod::kFractalWavelet};

TEST(SquareSquare, SpreadsOnePostIntoTheBiquadraticSpline) {
  FractalWorld w = even_world(9, 0, {0, 0.8F});
  w.heights[4 * 9 + 4] = 64;
  const std::vector<float> fine = synthesise(w, whole_task(FractalMethod::kSquareSquare, 1, 9));
  const float taps[] = {1, 4, 6, 4, 1};
  for (int j = 0; j < 17; ++j)
    for (int i = 0; i < 17; ++i) {
      const int a = i - 6, b = j - 6;
      EXPECT_EQ(fine[static_cast<std::size_t>(j * 17 + i)],
                a >= 0 && a < 5 && b >= 0 && b < 5 ? taps[a] * taps[b] : 0.0F)
          << i << "," << j;
    }
}

TEST(DiamondSquare, KeepsEveryPostAndObeysItsDeviationAtEachIteration) {
  const NodeRoughness node{4, 0.6F};
  const FractalWorld w = even_world(33, 100, node);
  std::vector<float> before = w.heights;
  int side = 33;
  for (int n = 1; n <= 4; ++n) {
    const std::vector<float> fine = synthesise(w, whole_task(FractalMethod::kDiamondSquare, n, 33));
    const int fine_side = 2 * side - 1;
    const auto at = [&](int i, int j) {
      return static_cast<double>(before[static_cast<std::size_t>(j * side + i)]);
    };
    double sum = 0;
    for (int j = 0; j < side; ++j)
      for (int i = 0; i < side; ++i) {
        ASSERT_EQ(fine[static_cast<std::size_t>(2 * j * fine_side + 2 * i)],
                  before[static_cast<std::size_t>(j * side + i)]);
        if (i + 1 == side || j + 1 == side) continue;
        const double centre = fine[static_cast<std::size_t>((2 * j + 1) * fine_side + 2 * i + 1)];
        const double d = centre - (at(i, j) + at(i + 1, j) + at(i, j + 1) + at(i + 1, j + 1)) / 4;
        sum += d * d;
      }
    const double predicted = node_deviation(node, n, NodeKind::kDiamondCentre);
    EXPECT_NEAR(std::log2(sum / ((side - 1.0) * (side - 1.0))), 2 * std::log2(predicted), 0.25)
        << "iteration " << n;
    before = fine;
    side = fine_side;
  }
}

// A step of roughness between two nodes must not show as a line: second differences across the border are
// what they are beside it.
TEST(Midpoint, LeavesNoCreaseBetweenUnlikeNodes) {
  for (const FractalMethod method : kMethods) {
    FractalWorld w = even_world(65, 0, {1, 0.9F});
    for (std::size_t n = 0; n < w.nodes.nodes.size(); ++n)
      if (n % 2) w.nodes.nodes[n] = {8, 0.4F};
    double at_border = 0, beside = 0;
    for (std::uint64_t seed = 1; seed <= 24; ++seed) {
      FractalTask t = whole_task(method, 2, 65);
      t.seed = seed;
      const std::vector<float> fine = synthesise(w, t);
      const auto energy = [&](int i) {
        double sum = 0;
        for (int j = 0; j < 257; ++j) {
          const float* row = fine.data() + j * 257 + i;
          const double d = static_cast<double>(row[0]) -
                           0.5 * (static_cast<double>(row[-1]) + static_cast<double>(row[1]));
          sum += d * d;
        }
        return sum;
      };
      for (const int border : {64, 128, 192}) {  // columns of data posts, like those beside them
        at_border += energy(border);
        beside += (energy(border - 4) + energy(border + 4)) / 2;
      }
    }
    EXPECT_NEAR(at_border / beside, 1.0, 0.08) << static_cast<int>(method);
  }
}

HeightGrid random_grid(std::uint32_t seed, PostWindow w, float scale_m) {
  std::mt19937 rng(seed);
  HeightGrid g{w, {}, {}};
  for (std::int64_t n = 0; n < w.width() * w.height(); ++n)
    g.heights_m.push_back(scale_m * (static_cast<float>(rng() >> 8) * 0x1p-23F - 1));
  return g;
}

FractalDetail random_detail(std::uint32_t seed, const PostWindow& coarse, bool periodic, int margin = 0) {
  FractalDetail d;
  d.coarse = coarse;
  for (std::uint32_t band = 1; band <= 3; ++band) {
    d.delta_m[band - 1] = random_grid(seed * 3 + band, coarse, 10).heights_m;
    for (std::int64_t j = 0; j < coarse.height(); ++j)
      for (std::int64_t i = 0; i < coarse.width(); ++i) {
        const bool exists =
            periodic || (i < coarse.width() - (band & 1) && j < coarse.height() - (band >> 1));
        const bool inner =
            i >= margin && j >= margin && i < coarse.width() - 1 - margin && j < coarse.height() - 1 - margin;
        if (!exists || (margin > 0 && !inner))
          d.delta_m[band - 1][static_cast<std::size_t>(j * coarse.width() + i)] = 0;
      }
  }
  return d;
}

TEST(FractalWavelet, SpreadsOneCentreAsPrinted) {
  const PostWindow w{0, 0, 6, 6};
  const HeightGrid zeros{w, std::vector<float>(49, 0.0F), {}};
  FractalDetail d{w,
                  {std::vector<float>(49, 0.0F), std::vector<float>(49, 0.0F), std::vector<float>(49, 0.0F)}};
  d.delta_m[2][2 * 7 + 3] = 32;
  const Result<HeightGrid> fine = refine(zeros, d, {VolumeRule::kPublished, FractalBorder::kRule});
  ASSERT_TRUE(fine) << fine.error().message;
  const float expected[5][5] = {{0, -1, -1, -1, -1},
                                {-1, -2, -2, -2, -1},
                                {-1, -2, 30, -2, -1},
                                {-1, -2, -2, -2, -1},
                                {-1, -1, -1, -1, 0}};
  for (int j = 0; j < 5; ++j)
    for (int i = 0; i < 5; ++i)
      EXPECT_EQ(fine->at(5 + i, 3 + j), expected[j][i]) << "row " << 3 + j << " column " << 5 + i;
}

TEST(FractalWavelet, KeepsTheVolumeOfAnyGridBordersIncluded) {
  for (std::uint32_t n = 0; n < 200; ++n) {
    const PostWindow w{n % 5, n % 3, n % 5 + 1 + n % 17, n % 3 + 1 + n % 23};
    const HeightGrid coarse = random_grid(n, w, 100);
    const Result<HeightGrid> fine = refine(coarse, random_detail(n, w, false), {});
    ASSERT_TRUE(fine) << fine.error().message;
    const double area = static_cast<double>((w.width() - 1) * (w.height() - 1));
    // a fine cell is a quarter of a coarse one
    EXPECT_NEAR(surface_volume(*fine, FractalBorder::kRule) / 4, surface_volume(coarse, FractalBorder::kRule),
                1e-5 * 100 * area)
        << n;
  }
}

TEST(FractalWavelet, KeepsTheVolumeOfATorus) {
  for (std::uint32_t n = 0; n < 50; ++n) {
    const PostWindow w{0, 0, 1 + 2 * (n % 9), 3 + 2 * (n % 7)};
    const HeightGrid coarse = random_grid(n, w, 100);
    const Result<HeightGrid> fine =
        refine(coarse, random_detail(n, w, true), {VolumeRule::kTriangle, FractalBorder::kPeriodic});
    ASSERT_TRUE(fine) << fine.error().message;
    EXPECT_NEAR(surface_volume(*fine, FractalBorder::kPeriodic) / 4,
                surface_volume(coarse, FractalBorder::kPeriodic),
                1e-5 * 100 * static_cast<double>(w.width() * w.height()))
        << n;
  }
}

// The printed constants give back three quarters of what the new points add.
TEST(FractalWavelet, PublishedConstantsDriftByAQuarterOfTheNewVolume) {
  const PostWindow w{0, 0, 20, 20};
  const HeightGrid coarse = random_grid(3, w, 100);
  const FractalDetail d = random_detail(3, w, false);
  const Result<HeightGrid> fine = refine(coarse, d, {VolumeRule::kPublished, FractalBorder::kRule});
  ASSERT_TRUE(fine);
  double added = 0;
  for (std::int64_t j = 0; j < 21; ++j)
    for (std::int64_t i = 0; i < 21; ++i) {
      const std::size_t n = static_cast<std::size_t>(j * 21 + i);
      added += static_cast<double>(d.delta_m[2][n]) / 3;
      added += static_cast<double>(d.delta_m[0][n]) * ((j > 0) + (j < 20)) / 12.0;
      added += static_cast<double>(d.delta_m[1][n]) * ((i > 0) + (i < 20)) / 12.0;
    }
  EXPECT_GT(std::abs(added), 1);
  EXPECT_NEAR(surface_volume(*fine, FractalBorder::kRule) / 4 - surface_volume(coarse, FractalBorder::kRule),
              added / 4, 1e-2);
}

// Displacements inside a region leave the ground at its border, hence its mean gradient, as it was.
TEST(FractalWavelet, KeepsTheMeanGradientAroundInnerDisplacements) {
  const PostWindow w{0, 0, 16, 12};
  const HeightGrid coarse = random_grid(5, w, 100);
  FractalDetail none = random_detail(5, w, false);
  for (auto& band : none.delta_m) std::fill(band.begin(), band.end(), 0.0F);
  const Result<HeightGrid> plain = refine(coarse, none, {});
  const Result<HeightGrid> fine = refine(coarse, random_detail(5, w, false, 2), {});
  ASSERT_TRUE(plain && fine);
  int moved = 0;
  for (std::int64_t j = 0; j <= 24; ++j)
    for (std::int64_t i = 0; i <= 32; ++i) {
      if (i == 0 || j == 0 || i == 32 || j == 24)
        EXPECT_EQ(fine->at(i, j), plain->at(i, j));
      else
        moved += fine->at(i, j) != plain->at(i, j);
    }
  EXPECT_GT(moved, 300);
}

TEST(FractalWavelet, ReduceAndRefineUndoEachOther) {
  for (std::uint32_t n = 0; n < 200; ++n) {
    const bool periodic = n % 4 == 0;
    const FractalWaveletOptions options{static_cast<VolumeRule>(n % 2),
                                        periodic ? FractalBorder::kPeriodic : FractalBorder::kRule};
    const std::int64_t a = 2 * (n % 6) + 1, b = 2 * (n % 5) + 1;
    const PostWindow w =
        periodic ? PostWindow{0, 0, a, b} : PostWindow{n % 3, n % 2, n % 3 + a, n % 2 + b + 1};
    const HeightGrid coarse = random_grid(n, w, 1000);
    const FractalDetail detail = random_detail(n, w, periodic);
    const Result<HeightGrid> fine = refine(coarse, detail, options);
    ASSERT_TRUE(fine) << fine.error().message;
    const Result<FractalReduction> back = reduce(*fine, fine->window, w, options);
    ASSERT_TRUE(back) << back.error().message;
    const double bound = 1100 * 0x1p-20;
    for (std::size_t k = 0; k < coarse.heights_m.size(); ++k) {
      ASSERT_NEAR(back->coarse.heights_m[k], coarse.heights_m[k], bound) << n;
      for (std::size_t band = 0; band < 3; ++band)
        ASSERT_NEAR(back->detail.delta_m[band][k], detail.delta_m[band][k], 2 * bound) << n;
    }
    const Result<HeightGrid> again = refine(back->coarse, back->detail, options);
    ASSERT_TRUE(again);
    for (std::size_t k = 0; k < fine->heights_m.size(); ++k)
      ASSERT_NEAR(again->heights_m[k], fine->heights_m[k], bound) << n;
  }
}

TEST(FractalWavelet, ReducesPartsAsItReducesTheWhole) {
  for (std::uint32_t n = 0; n < 100; ++n) {
    const PostWindow world{n % 4, n % 3, n % 4 + 20 + n % 9, n % 3 + 17 + n % 5};  // odd corners too
    const HeightGrid fine = random_grid(n, world, 500);
    const PostWindow all{world.i0 >> 1, world.j0 >> 1, (world.i1 + 1) >> 1, (world.j1 + 1) >> 1};
    const Result<FractalReduction> whole = reduce(fine, world, all, {});
    ASSERT_TRUE(whole) << whole.error().message;
    const PostWindow part{all.i0 + n % 5, all.j0 + n % 4, all.i1 - n % 3, all.j1 - n % 4};
    const PostWindow reads = reduction_window(part, world);
    HeightGrid crop{reads, {}, {}};
    for (std::int64_t j = reads.j0; j <= reads.j1; ++j)
      for (std::int64_t i = reads.i0; i <= reads.i1; ++i) crop.heights_m.push_back(fine.at(i, j));
    const Result<FractalReduction> some = reduce(crop, world, part, {});
    ASSERT_TRUE(some) << some.error().message;
    for (std::int64_t j = part.j0; j <= part.j1; ++j)
      for (std::int64_t i = part.i0; i <= part.i1; ++i) {
        ASSERT_EQ(some->coarse.at(i, j), whole->coarse.at(i, j)) << n << ": " << i << "," << j;
        for (std::size_t band = 0; band < 3; ++band)
          ASSERT_EQ(some->detail.delta_m[band][some->coarse.index(i, j)],
                    whole->detail.delta_m[band][whole->coarse.index(i, j)])
              << n;
      }
  }
}

TEST(FractalWavelet, CoarseningATileLevelByLevelGivesTheDataBack) {
  for (int depth = 1; depth <= 5; ++depth) {
    for (const bool erosion : {false, true}) {
      const FractalWorld w = testing::random_fractal_world(static_cast<std::uint32_t>(depth), 17, 17, 2);
      FractalTask t = whole_task(FractalMethod::kFractalWavelet, depth, 17);
      t.parameters.erosion = erosion;
      const std::vector<float> heights = synthesise(w, t);
      HeightGrid grid{finer(w.world, depth), heights, {}};
      for (int k = 0; k < depth; ++k) {
        const PostWindow coarse{0, 0, grid.window.i1 / 2, grid.window.j1 / 2};
        Result<FractalReduction> less = reduce(grid, grid.window, coarse, {});
        ASSERT_TRUE(less);
        grid = std::move(less->coarse);
      }
      for (std::size_t n = 0; n < w.heights.size(); ++n)
        ASSERT_NEAR(grid.heights_m[n], w.heights[n], (depth + 1) * 0x1p-20 * 700) << "depth " << depth;
    }
  }
}

// Neighbours give way at the same time, so some pits remain.
TEST(FractalWavelet, ErosionRemovesPitsOnHillsAboveWater) {
  FractalWorld w = even_world(33, 100, {5, 0.6F});
  for (std::size_t n = 0; n < w.heights.size(); ++n) {
    w.heights[n] +=
        60 * std::sin(static_cast<float>(n % 33) * 0.5F) * std::cos(static_cast<float>(n / 33) * 0.4F);
  }
  const auto pits = [&](bool erosion, std::optional<float> water) {
    FractalTask t = whole_task(FractalMethod::kFractalWavelet, 3, 33);
    t.parameters.erosion = erosion;
    t.parameters.water_m = water;
    const std::vector<float> h = synthesise(w, t);
    int count = 0;
    for (std::size_t j = 1; j < 256; ++j) {
      for (std::size_t i = 1; i < 256; ++i) {
        const float* p = h.data() + j * 257 + i;
        bool is_pit = true;
        for (const int step : {1, 256, 257, 258}) is_pit = is_pit && *p < *(p - step) && *p < *(p + step);
        count += is_pit;
      }
    }
    return count;
  };
  const int without = pits(false, {});
  EXPECT_GT(without, 1000);
  EXPECT_LT(pits(true, {}), 0.75 * without);
  EXPECT_EQ(pits(true, 1e6F), without);  // all under water: no erosion
}

TEST(FractalWavelet, CapAndAltitudeBoundTheDisplacements) {
  const FractalWorld w = even_world(17, 100, {10, 0.6F});
  FractalTask t = whole_task(FractalMethod::kFractalWavelet, 1, 17);
  t.parameters.cap_m = 1.5F;
  HeightGrid fine{finer(w.world, 1), synthesise(w, t), {}};
  Result<FractalReduction> capped = reduce(fine, fine.window, w.world, {});
  ASSERT_TRUE(capped);
  int at_cap = 0;
  for (const std::vector<float>& band : capped->detail.delta_m)
    for (const float d : band) {
      ASSERT_LE(std::abs(d), 1.5F + 1e-3F);
      at_cap += std::abs(d) > 1.49F;
    }
  EXPECT_GT(at_cap, 100);
  t.parameters.cap_m.reset();
  t.parameters.altitude = AltitudeRule{200, 300, 0, 1};  // the ground lies at 100 m: factor 0
  for (const float h : synthesise(w, t)) ASSERT_EQ(h, 100.0F);
}

MaskCrop even_mask(const FractalTask& t, int level, std::uint8_t value) {
  const PostWindow w = mask_window(t, level);
  return {level,
          w.i0,
          w.j0,
          static_cast<int>(w.width()),
          static_cast<int>(w.height()),
          std::vector<std::uint8_t>(static_cast<std::size_t>(w.width() * w.height()), value)};
}

TEST(FractalMask, WhiteRemovesAllBlackNothingGreyItsShareOfEnergy) {
  for (const FractalMethod method : kMethods) {
    for (const int level : {-2, 0, 3}) {
      FractalWorld w = testing::random_fractal_world(7, 9, 9, 2), calm = w;
      for (NodeRoughness& n : calm.nodes.nodes) n.sigma_m = 0;
      FractalTask t = whole_task(method, 3, 9);
      t.world = w.world;
      const std::vector<float> rough = synthesise(w, t), plain = synthesise(calm, t);
      for (const MaskMode mode : {MaskMode::kAbsorb, MaskMode::kProtect}) {
        t.mask_mode = mode;
        t.mask = even_mask(t, level, 255);
        EXPECT_EQ(synthesise(w, t), plain);
        t.mask = even_mask(t, level, 0);
        EXPECT_EQ(synthesise(w, t), rough);
        t.mask = even_mask(t, level, 191);  // a quarter of the energy is left, less half a grey
        const std::vector<float> grey = synthesise(w, t);
        const float share = std::sqrt(64.0F / 255.0F);
        for (std::size_t n = 0; n < grey.size(); ++n)
          ASSERT_NEAR(grey[n] - plain[n], share * (rough[n] - plain[n]), 2e-3);
      }
    }
  }
}

TEST(FractalMask, HardPixelsHoldTheGroundWithoutDisplacement) {
  for (const FractalMethod method : kMethods) {
    for (const bool as_void : {false, true}) {
      FractalWorld w = testing::random_fractal_world(8, 17, 17, 2), calm = w;
      for (NodeRoughness& n : calm.nodes.nodes) n.sigma_m = 0;
      FractalTask t = whole_task(method, 4, 17);
      t.parameters.erosion = method == FractalMethod::kFractalWavelet && as_void;
      t.world = w.world;
      const std::vector<float> plain = synthesise(calm, t);
      MaskCrop mask = even_mask(t, 0, 0);
      const auto whiten = [&](std::int64_t i, std::int64_t j) {
        mask.pixels[static_cast<std::size_t>((j - mask.j0) * mask.width + i - mask.i0)] = 255;
      };
      whiten(5, 6);
      whiten(0, 15);
      if (as_void) {
        t.void_mask = mask;
      } else {
        t.mask = mask;
        t.mask_mode = MaskMode::kProtect;
      }
      const std::vector<float> held = synthesise(w, t);
      int differing = 0;
      for (std::size_t j = 0; j < 257; ++j)
        for (std::size_t i = 0; i < 257; ++i) {
          const bool in_white = (i >= 80 && i <= 96 && j >= 96 && j <= 112) || (i <= 16 && j >= 240);
          if (in_white)
            ASSERT_EQ(held[j * 257 + i], plain[j * 257 + i])
                << static_cast<int>(method) << ": " << i << "," << j;
          else
            differing += held[j * 257 + i] != plain[j * 257 + i];
        }
      EXPECT_GT(differing, 30000);
    }
  }
}

TEST(Fractal, SeedsGiveOtherGroundOfTheSameKind) {
  for (const FractalMethod method : kMethods) {
    const FractalWorld w = even_world(33, 0, {5, 0.7F});
    const auto energy = [&](std::uint64_t seed) {
      FractalTask t = whole_task(method, 2, 33);
      t.seed = seed;
      double sum = 0;
      for (const float h : synthesise(w, t)) sum += static_cast<double>(h) * static_cast<double>(h);
      return sum;
    };
    const double a = energy(1), b = energy(2), c = energy(1ull << 63);
    EXPECT_NE(a, b);
    EXPECT_NE(a, c);
    EXPECT_NEAR(a / b, 1, 0.3);
    EXPECT_NEAR(a / c, 1, 0.3);
  }
}

}  // namespace
}  // namespace lodestone
