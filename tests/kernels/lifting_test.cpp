// Lifting: the vectors of the specification, reversibility, and the same bits on the device.

#include "kernels/wavelet/lifting.h"

#include <gtest/gtest.h>

#include <random>

#include "tests/support/wavelet_run.h"

namespace lodestone {
namespace {

const std::vector<float> kH5{100, 104, 112, 108, 96, 102, 110, 120, 114, 100, 98, 107, 125, 119, 104, 95, 101, 116, 111, 99, 90, 97, 108, 103, 94};

GridBands flat_bands(float d1, float d3) {
  GridBands bands{5, 5, std::vector<float>(9), {std::vector<float>(6), std::vector<float>(6), std::vector<float>(4)}};
  bands.detail_m[0][2] = d1;  // row 1, column 0
  bands.detail_m[2][1] = d3;  // row 0, column 1
  return bands;
}

TEST(Lifting, SpreadsOneDetailAsTheSpecificationSays) {
  // d1[1,0] in the notation [row, column].
  EXPECT_EQ(inverse_lifting(WaveletBasis::kCdf22, flat_bands(64, 0)),
            (std::vector<float>{0, 0, 0, 0, 0, -16, 20, -8, -4, 0, -32, 40, -16, -8, 0, -16, 20, -8, -4, 0, 0, 0, 0, 0, 0}));
  EXPECT_EQ(inverse_lifting(WaveletBasis::kCdf22, flat_bands(0, 64)),
            (std::vector<float>{0, 4, 8, -20, 16, 0, -5, -10, 25, -20, 0, 2, 4, -10, 8, 0, 1, 2, -5, 4, 0, 0, 0, 0, 0}));
}

TEST(Lifting, AnalysesTheExampleGrid) {
  const GridBands bands = forward_lifting(WaveletBasis::kCdf22, kH5, 5, 5);
  EXPECT_EQ(bands.low_m, (std::vector<float>{101.0625, 113.5, 97.9375, 96.875, 125.3125, 106.25, 89.1875, 107.625, 95.0625}));
  EXPECT_EQ(bands.detail_m[0], (std::vector<float>{-0.875, 3.875, -4.25, 4.5, -2.625, 2.125}));
  EXPECT_EQ(bands.detail_m[1], (std::vector<float>{4.125, 2, -0.125, 0.375, -0.75, 0.125}));
  EXPECT_EQ(bands.detail_m[2], (std::vector<float>{2.25, -0.25, -1.25, 0.25}));
}

TEST(Lifting, CubicScalingFilterSmoothsPosts) {
  // Zero details, one coarse value: the even posts become (c[i-1] + 6 c[i] + c[i+1]) / 8 per axis.
  GridBands bands{17, 17, std::vector<float>(81), {std::vector<float>(72), std::vector<float>(72), std::vector<float>(64)}};
  bands.low_m[4 * 9 + 4] = 64;
  const std::vector<float> fine = inverse_lifting(WaveletBasis::kCdf44, bands);
  EXPECT_EQ(fine[8 * 17 + 8], 36);
  EXPECT_EQ(fine[8 * 17 + 6], 6);
  EXPECT_EQ(fine[8 * 17 + 9], 24);
  EXPECT_EQ(fine[6 * 17 + 6], 1);
  EXPECT_EQ(fine[8 * 17 + 4], 0);
}

class AnyGrid : public ::testing::TestWithParam<std::tuple<int, int, WaveletBasis>> {};

TEST_P(AnyGrid, ComesBackAndHasTheDevicesBits) {
  const auto [width, height, basis] = GetParam();
  std::mt19937 rng(static_cast<unsigned>(width * 1000 + height));
  std::uniform_real_distribution<float> heights(-300, 4000);
  std::vector<float> grid;
  for (int n = 0; n < width * height; ++n) grid.push_back(heights(rng));
  const GridBands bands = forward_lifting(basis, grid, width, height);
  const std::vector<float> back = inverse_lifting(basis, bands);
  ASSERT_EQ(back.size(), grid.size());
  const float bound = basis == WaveletBasis::kCdf22 ? 2 * 4000.0f / (1 << 21) : 40 * 4000.0f / (1 << 21);
  for (std::size_t n = 0; n < grid.size(); ++n) ASSERT_NEAR(back[n], grid[n], bound) << n;

  ASSERT_NE(testing::test_device(), nullptr);
  auto device = DeviceLifting::create(testing::test_device());
  ASSERT_TRUE(device) << device.error().message;
  const Result<GridBands> other = (*device)->forward(basis, grid, width, height);
  ASSERT_TRUE(other) << other.error().message;
  EXPECT_EQ(testing::bits(other->low_m), testing::bits(bands.low_m));
  for (std::size_t band = 0; band < 3; ++band) EXPECT_EQ(testing::bits(other->detail_m[band]), testing::bits(bands.detail_m[band])) << band;
  const Result<std::vector<float>> fine = (*device)->inverse(basis, bands);
  ASSERT_TRUE(fine) << fine.error().message;
  EXPECT_EQ(testing::bits(*fine), testing::bits(back));
}
INSTANTIATE_TEST_SUITE_P(Sizes, AnyGrid,
                         ::testing::Combine(::testing::Values(2, 3, 5, 6, 33, 34, 129, 200), ::testing::Values(2, 3, 17, 18, 65),
                                            ::testing::Values(WaveletBasis::kCdf22, WaveletBasis::kCdf44)));

}  // namespace
}  // namespace lodestone
