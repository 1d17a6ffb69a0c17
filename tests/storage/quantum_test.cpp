#include "storage/formats/quantum.h"

#include <gtest/gtest.h>

#include <bit>
#include <cmath>
#include <limits>
#include <random>
#include <vector>

#include "storage/formats/exr_tile.h"

namespace lodestone {
namespace {

TEST(Quantum, MustBeAPowerOfTwoInItsRange) {
  for (int e = -10; e <= 6; ++e) EXPECT_TRUE(check_quantum(std::ldexp(1.0f, e))) << e;
  for (const float bad : {0.0f, -0.25f, 0.1f, 0.3f, 3.0f, 128.0f, 0x1p-11f, std::numeric_limits<float>::infinity(),
                          std::numeric_limits<float>::quiet_NaN()}) {
    std::vector<float> heights_m = {0.3f};
    auto result = quantise(heights_m, bad);
    ASSERT_FALSE(result) << bad;
    EXPECT_EQ(result.error().code, ErrorCode::kInvalidArgument);
    EXPECT_NE(result.error().message.find("power of two"), std::string::npos) << result.error().message;
    EXPECT_EQ(heights_m[0], 0.3f);
  }
}

TEST(Quantum, RoundsToTheNearestMultipleAndOnlyOnce) {
  std::mt19937 random(7);
  for (int e = -10; e <= 6; ++e) {
    const float q = std::ldexp(1.0f, e);
    std::vector<float> heights_m = {0.0f, -0.0f, 0.5f * q, 1.5f * q, 2.5f * q, -0.5f * q, -0.25f * q, -1.5f * q};
    for (int k = 0; k < 20000; ++k) {
      const float scale = std::ldexp(1.0f, static_cast<int>(random() % 40) - 12);
      heights_m.push_back((static_cast<float>(random() >> 8) / 8388608.0f - 1.0f) * scale);
    }
    auto rounded = heights_m;
    ASSERT_TRUE(quantise(rounded, q));
    for (std::size_t k = 0; k < heights_m.size(); ++k) {
      const double expected = std::nearbyint(static_cast<double>(heights_m[k]) / q) * q;
      ASSERT_EQ(rounded[k], static_cast<float>(expected)) << heights_m[k] << " with quantum " << q;
      ASSERT_NE(std::bit_cast<std::uint32_t>(rounded[k]), 0x80000000u) << "minus zero from " << heights_m[k];
    }
    auto again = rounded;
    ASSERT_TRUE(quantise(again, q));
    EXPECT_EQ(again, rounded);
  }
}

TEST(Quantum, LeavesHugeAndOddValuesAlone) {
  const float infinite = std::numeric_limits<float>::infinity();
  std::vector<float> heights_m = {3e38f, -3e38f, infinite, -infinite, std::numeric_limits<float>::quiet_NaN()};
  ASSERT_TRUE(quantise(heights_m, 64.0f));
  EXPECT_EQ(heights_m[0], 3e38f);
  EXPECT_EQ(heights_m[1], -3e38f);
  EXPECT_EQ(heights_m[2], infinite);
  EXPECT_EQ(heights_m[3], -infinite);
  EXPECT_TRUE(std::isnan(heights_m[4]));
}

TEST(AutoQuantum, FollowsItsRule) {
  EXPECT_EQ(auto_quantum(1000, 30), 0x1p-4f);
  EXPECT_EQ(auto_quantum(1000, 30000), 0x1p-4f);   // never coarser than 1/16 m for the spacing's sake
  EXPECT_EQ(auto_quantum(100, 1.0), 0x1p-8f);
  EXPECT_EQ(auto_quantum(100, 0.9), 0x1p-9f);
  EXPECT_EQ(auto_quantum(10, 0.001), 0x1p-10f);
  EXPECT_EQ(auto_quantum(1000, 1.0), 0x1p-5f);     // 1/256 m would not fit PXR24: 1062.5 m / 65536 = 1/61.7
  EXPECT_EQ(auto_quantum(3855, 30), 0x1p-4f);
  EXPECT_EQ(auto_quantum(3856, 30), 0x1p-3f);
  EXPECT_EQ(auto_quantum(8849, 30), 0x1p-2f);
  EXPECT_EQ(auto_quantum(0, 0), 0x1p-4f);
  EXPECT_EQ(auto_quantum(1e30, 1), 64.0f);
  const double nan = std::numeric_limits<double>::quiet_NaN();
  EXPECT_TRUE(check_quantum(auto_quantum(nan, nan)));
}

TEST(AutoQuantum, KeepsPxr24LosslessUpToASixteenthAboveTheSummit) {
  std::mt19937 random(3);
  for (const double summit_m : {5.0, 63.0, 250.0, 1000.0, 3855.0, 3900.0, 8849.0, 21000.0}) {
    for (const double spacing_m : {0.01, 0.5, 5.0, 90.0}) {
      const float quantum_m = auto_quantum(summit_m, spacing_m);
      ASSERT_TRUE(check_quantum(quantum_m));
      std::vector<float> heights_m = {static_cast<float>(summit_m * 17 / 16), static_cast<float>(-summit_m)};
      while (heights_m.size() < 33 * 33) {
        heights_m.push_back(static_cast<float>((static_cast<double>(random()) / 2147483648.0 - 1.0) * summit_m * 17 / 16));
      }
      ASSERT_TRUE(quantise(heights_m, quantum_m));
      auto encoded = encode_exr_tile(heights_m, {}, 33, {}, {ExrCompression::kPxr24});
      ASSERT_TRUE(encoded);
      auto decoded = decode_exr_tile({reinterpret_cast<const std::uint8_t*>(encoded->data()), encoded->size()});
      ASSERT_TRUE(decoded) << decoded.error().message;
      EXPECT_EQ(decoded->heights_m, heights_m) << summit_m << " m, spacing " << spacing_m << " m, quantum " << quantum_m << " m";
    }
  }
}

}  // namespace
}  // namespace lodestone
