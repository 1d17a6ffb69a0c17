// Known answers of the random numbers.

#include <gtest/gtest.h>

#include <bit>
#include <cmath>

#include "kernels/shared/ls_random.h"

namespace lodestone {
namespace {

constexpr std::uint32_t kSeed0 = 0x89abcdef, kSeed1 = 0x01234567;

std::array<std::uint32_t, 4> philox(std::uint32_t c0, std::uint32_t c1, std::uint32_t c2, std::uint32_t c3, std::uint32_t k0, std::uint32_t k1) {
  const ls_words w = ls_philox(c0, c1, c2, c3, k0, k1);
  return {w.w0, w.w1, w.w2, w.w3};
}
using Words = std::array<std::uint32_t, 4>;

TEST(Philox, GivesTheKnownAnswersOfTheAuthors) {
  EXPECT_EQ(philox(0, 0, 0, 0, 0, 0), (Words{0x6627e8d5, 0xe169c58d, 0xbc57ac4c, 0x9b00dbd8}));
  EXPECT_EQ(philox(~0u, ~0u, ~0u, ~0u, ~0u, ~0u), (Words{0x408f276d, 0x41c83b0e, 0xa20bc7c6, 0x6d5451fd}));
  EXPECT_EQ(philox(0x243f6a88, 0x85a308d3, 0x13198a2e, 0x03707344, 0xa4093822, 0x299f31d0), (Words{0xd16cfe09, 0x94fdcceb, 0x5001e420, 0x24126ea1}));
  EXPECT_EQ(philox(0, 0, ls_stream(8, 1, LS_ALGO_WAVELET, 0), 0, kSeed0, kSeed1), (Words{0x5391f4b6, 0x981af2cf, 0xee613536, 0x9dadea07}));
}

std::uint32_t gaussian_bits(std::uint32_t algo, std::uint32_t band, std::uint32_t level, std::uint32_t i, std::uint32_t j) {
  return std::bit_cast<std::uint32_t>(ls_gaussian(i, j, ls_stream(level, band, algo, 0), kSeed0, kSeed1));
}

TEST(Gaussian, GivesTheBitsOfTheSpecification) {
  EXPECT_EQ(gaussian_bits(1, 1, 8, 0, 0), 0x3feac623u);
  EXPECT_EQ(gaussian_bits(1, 1, 8, 1, 0), 0xbf18b11eu);
  EXPECT_EQ(gaussian_bits(1, 1, 8, 0, 1), 0xbe95a564u);
  EXPECT_EQ(gaussian_bits(1, 2, 8, 0, 0), 0xc0081819u);
  EXPECT_EQ(gaussian_bits(1, 3, 9, 1000, 70000), 0x3fc247f9u);
  EXPECT_EQ(gaussian_bits(4, 3, 12, 2147483647, 1), 0x3f752d95u);
}

TEST(Gaussian, IsBounded) {
  EXPECT_EQ(std::bit_cast<std::uint32_t>(ls_gaussian_from_words({0, 0, 0, 0})), 0xc0d22ea0u);
  EXPECT_EQ(ls_gaussian_from_words({~0u, ~0u, ~0u, ~0u}), LS_GAUSSIAN_MAX);
}

TEST(Gaussian, HasTheMomentsOfANormalVariable) {
  constexpr int kCount = 1 << 20;
  double sum = 0, square = 0, fourth = 0;
  for (std::uint32_t n = 0; n < kCount; ++n) {
    const double g = ls_gaussian(n & 1023, n >> 10, ls_stream(5, 2, 1, 0), 7, 9);
    sum += g;
    square += g * g;
    fourth += g * g * g * g;
  }
  EXPECT_NEAR(sum / kCount, 0, 5.0 / 1024);
  EXPECT_NEAR(square / kCount, 1, 5 * std::sqrt(2.0) / 1024);
  EXPECT_NEAR(fourth / kCount, 3, 5 * std::sqrt(96.0) / 1024);
}

}  // namespace
}  // namespace lodestone
