// Mask guided reconstruction: the vectors and theorems of SPEC-SYNTHESIS section 4, on the host and on the device.

#include <gtest/gtest.h>

#include <cmath>

#include "kernels/wavelet/lifting.h"
#include "tests/support/wavelet_run.h"

namespace lodestone {
namespace {

using testing::run_both;
using testing::World;

// k-fold linear interpolation of the whole world, y first.
std::vector<float> linear_levels(const World& world, int depth) {
  std::vector<float> grid = world.heights_m;
  auto w = static_cast<std::size_t>(world.window.width()), h = static_cast<std::size_t>(world.window.height());
  for (int n = 0; n < depth; ++n) {
    const std::size_t fw = 2 * w - 1, fh = 2 * h - 1;
    std::vector<float> fine(fw * fh);
    for (std::size_t j = 0; j < fh; ++j)
      for (std::size_t i = 0; i < fw; ++i) {
        const auto column = [&](std::size_t x) {
          return j % 2 == 0 ? grid[j / 2 * w + x] : (grid[j / 2 * w + x] + grid[(j / 2 + 1) * w + x]) * 0.5f;
        };
        fine[j * fw + i] = i % 2 == 0 ? column(i / 2) : (column(i / 2) + column(i / 2 + 1)) * 0.5f;
      }
    grid = fine;
    w = fw;
    h = fh;
  }
  return grid;
}

TEST(MaskSums, MatchTheExample) {
  World world = testing::make_world(0, 0, 5, 5, 1);
  testing::add_mask(world, 0, 1, 250);
  world.mask.assign(16, 0);
  world.mask[1 * 4 + 1] = 255;
  world.mask[2 * 4 + 2] = 128;
  const WaveletTask task = testing::task_over(world, WaveletMethod::kGsa, 1, 9);
  const testing::Reference reference(world, task);
  const std::vector<std::int64_t> row1{9180, 122400, 9180, 0}, row2{9180, 127008, 70620, 4608};
  const std::vector<float> factors{0.9712308f, 0.49165162f, 0.95646363f, 0.99893194f};
  for (int i = 0; i < 4; ++i) {
    const auto n = static_cast<std::size_t>(i);
    EXPECT_EQ(reference.removed(0, 0, i, 1), row1[n]) << i;
    EXPECT_EQ(reference.removed(0, 0, i, 2), row2[n]) << i;
    const auto s = static_cast<float>(reference.removed(0, 2, i, 1));
    EXPECT_EQ(std::sqrt((1020.0f * 2116.0f - s) / (1020.0f * 2116.0f)), factors[n]) << i;
  }
  // And the tile is made with these sums.
  testing::Reference all(world, task);
  const std::vector<float> tile = run_both(task);
  for (int j = 0; j < 9; ++j)
    for (int i = 0; i < 9; ++i) EXPECT_EQ(tile[static_cast<std::size_t>(j * 9 + i)], all.height(1, i, j)) << i << "," << j;
}

class EveryMaskLevel : public ::testing::TestWithParam<std::tuple<int, WaveletMethod>> {};

TEST_P(EveryMaskLevel, WhiteIsLinearInterpolation) {
  const auto [level, method] = GetParam();
  World world = testing::make_world(0, 0, 17, 17, 3);
  for (float& h : world.heights_m) h = std::round(h);
  testing::add_mask(world, level, 1, 255);
  const std::vector<float> white = run_both(testing::task_over(world, method, 4, 257)), expected = linear_levels(world, 4);
  EXPECT_EQ(white, expected);
  world.mask.clear();
  EXPECT_EQ(testing::bits(white), testing::bits(run_both(testing::task_over(world, WaveletMethod::kLinear, 4, 257))));
  // One black pixel far away: no longer uniform, the rest still linear.
  testing::add_mask(world, level, 1, 255);
  world.mask[0] = 0;
  const std::vector<float> partly = run_both(testing::task_over(world, method, 4, 257));
  const int reach = 16 * (2 + (level < 0 ? 1 << -level : 1));
  EXPECT_NE(partly, expected);
  for (int j = 0; j < 257; ++j)
    for (int i = 0; i < 257; ++i) {
      if (i < reach && j < reach) continue;
      ASSERT_EQ(partly[static_cast<std::size_t>(j * 257 + i)], expected[static_cast<std::size_t>(j * 257 + i)]) << i << "," << j;
    }
}

TEST_P(EveryMaskLevel, BlackChangesNothing) {
  const auto [level, method] = GetParam();
  World world = testing::make_world(0, 0, 17, 17, 4);
  const std::vector<float> bare = run_both(testing::task_over(world, method, 3, 129));
  testing::add_mask(world, level, 1, 255);
  world.mask.assign(world.mask.size(), 0);
  EXPECT_EQ(testing::bits(bare), testing::bits(run_both(testing::task_over(world, method, 3, 129))));
}

TEST_P(EveryMaskLevel, GrayRemovesItsShareOfTheEnergy) {
  const auto [level, method] = GetParam();
  World world = testing::make_world(0, 0, 33, 33, 5);
  world.heights_m.assign(world.heights_m.size(), 0);
  const GridBands bare = forward_lifting(WaveletBasis::kCdf22, run_both(testing::task_over(world, method, 1, 65)), 65, 65);
  testing::add_mask(world, level, 1, 100);
  const GridBands gray = forward_lifting(WaveletBasis::kCdf22, run_both(testing::task_over(world, method, 1, 65)), 65, 65);
  for (std::size_t band = 0; band < 3; ++band) {
    double before = 0, after = 0;
    for (const float d : bare.detail_m[band]) before += double{d} * d;
    for (const float d : gray.detail_m[band]) after += double{d} * d;
    EXPECT_NEAR(after / before, 1 - 100.0 / 255, level > 1 ? 2e-3 : 1e-4) << band;
  }
}

TEST_P(EveryMaskLevel, ReachesTwoCellsAtMost) {
  const auto [level, method] = GetParam();
  World world = testing::make_world(0, 0, 33, 33, 6);
  const std::vector<float> bare = run_both(testing::task_over(world, method, 3, 257));
  const std::vector<float> linear = run_both(testing::task_over(world, WaveletMethod::kLinear, 3, 257));
  testing::add_mask(world, level, 1, 255);
  for (std::int64_t j = 0; j < world.mask_height; ++j)
    for (std::int64_t i = 0; i < world.mask_width; ++i)
      if ((level >= 0 ? i >> level : i << -level) >= 16) world.mask[static_cast<std::size_t>(j * world.mask_width + i)] = 0;
  const std::vector<float> half = run_both(testing::task_over(world, method, 3, 257));
  int ramp = 0;
  for (int j = 0; j < 257; ++j)
    for (int i = 0; i < 257; ++i) {
      const auto n = static_cast<std::size_t>(j * 257 + i);
      if (i <= (16 - 2) * 8) {
        ASSERT_EQ(half[n], linear[n]) << i << "," << j;
      } else if (i >= (16 + 2) * 8) {
        ASSERT_EQ(half[n], bare[n]) << i << "," << j;
      } else {
        ramp += half[n] != linear[n] && half[n] != bare[n];
      }
    }
  EXPECT_GT(ramp, 1000);
}

INSTANTIATE_TEST_SUITE_P(Levels, EveryMaskLevel,
                         ::testing::Combine(::testing::Values(-1, 0, 1, 3, 5), ::testing::Values(WaveletMethod::kGsa, WaveletMethod::kLsa)));

class Protect : public ::testing::TestWithParam<int> {};

TEST_P(Protect, KeepsEveryPostOfAWhitePixelLinear) {
  const int level = GetParam(), depth = 3;
  World world = testing::make_world(0, 0, 33, 33, 7);
  const std::vector<float> linear = run_both(testing::task_over(world, WaveletMethod::kLinear, depth, 257));
  testing::add_mask(world, level, 5, 1);
  WaveletTask task = testing::task_over(world, WaveletMethod::kGsa, depth, 257);
  const std::vector<float> absorbed = run_both(task);
  task.mask_mode = MaskMode::kProtect;
  const std::vector<float> guarded = run_both(task);
  EXPECT_NE(absorbed, guarded);
  int white_posts = 0;
  for (int j = 0; j < 257; ++j)
    for (int i = 0; i < 257; ++i) {
      // Pixels whose closed area holds the post.
      bool is_white = false;
      for (int dj = -1; dj <= 0; ++dj)
        for (int di = -1; di <= 0; ++di) {
          if (level <= depth) {
            is_white = is_white || world.mask_at((i + di) >> (depth - level), (j + dj) >> (depth - level)) == 255;
          } else {
            is_white = is_white || world.mask_at((std::int64_t{i} << (level - depth)) + di, (std::int64_t{j} << (level - depth)) + dj) == 255;
          }
        }
      white_posts += is_white;
      const auto n = static_cast<std::size_t>(j * 257 + i);
      if (is_white) { ASSERT_EQ(guarded[n], linear[n]) << i << "," << j; }
    }
  EXPECT_GT(white_posts, 100);
  EXPECT_NE(guarded, linear);
}
INSTANTIATE_TEST_SUITE_P(Levels, Protect, ::testing::Values(-1, 0, 2, 4));

TEST(VoidMask, AlwaysProtects) {
  World world = testing::make_world(0, 0, 33, 33, 8);
  const std::vector<float> linear = run_both(testing::task_over(world, WaveletMethod::kLinear, 3, 257));
  world.void_mask.assign(32 * 32, 0);
  world.void_mask[16 * 32 + 16] = 255;
  const std::vector<float> tile = run_both(testing::task_over(world, WaveletMethod::kLsa, 3, 257));
  for (int j = 128; j <= 136; ++j)
    for (int i = 128; i <= 136; ++i) EXPECT_EQ(tile[static_cast<std::size_t>(j * 257 + i)], linear[static_cast<std::size_t>(j * 257 + i)]);
  EXPECT_NE(tile, linear);
}

}  // namespace
}  // namespace lodestone
