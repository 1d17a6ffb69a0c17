#pragma once
// Base-2 logarithm and power from + - * / and bit operations only, so that every IEEE machine gets the same
// bits. Branch-free and inline: loops over arrays of a fixed block length become vector code. Needs
// round-to-nearest and no contraction (the build sets -ffp-contract=off).

#include <array>
#include <bit>
#include <cstdint>

namespace lodestone::det {

// 2 / (ln 2 (2n + 1)): the series of log2((1 + z) / (1 - z)) in odd powers of z.
inline constexpr std::array<double, 10> kLogSeries = [] {
  std::array<double, 10> c{};
  for (int n = 0; n < 10; ++n) c[static_cast<std::size_t>(n)] = 2.885390081777926814719849362 / (2 * n + 1);
  return c;
}();

// (ln 2)^n / n!: the series of 2^r.
inline constexpr std::array<double, 13> kExpSeries = [] {
  std::array<double, 13> c{};
  c[0] = 1;
  for (int n = 1; n < 13; ++n) {
    c[static_cast<std::size_t>(n)] =
        c[static_cast<std::size_t>(n - 1)] * 0.693147180559945309417232121458 / n;
  }
  return c;
}();

// x: positive, normal, finite. x = 2^k m with m in [sqrt(1/2), sqrt(2)), log2 m by the series in z = (m - 1)
// / (m + 1), |z| < 0.172.
inline double log2(double x) {
  const std::uint64_t bits = std::bit_cast<std::uint64_t>(x);
  const std::uint64_t exponent =
      (bits + 0x00095f6200000000u) >> 52;  // biased; carries over from sqrt(2) upwards
  const double m = std::bit_cast<double>(bits - (exponent << 52) + 0x3ff0000000000000u);
  // exponent as the low bits of 2^52 + exponent
  const double k = std::bit_cast<double>(exponent | 0x4330000000000000u) - (4503599627370496.0 + 1023.0);
  const double z = (m - 1.0) / (m + 1.0);
  const double z2 = z * z;
  double p = kLogSeries[9];
  p = p * z2 + kLogSeries[8];
  p = p * z2 + kLogSeries[7];
  p = p * z2 + kLogSeries[6];
  p = p * z2 + kLogSeries[5];
  p = p * z2 + kLogSeries[4];
  p = p * z2 + kLogSeries[3];
  p = p * z2 + kLogSeries[2];
  p = p * z2 + kLogSeries[1];
  p = p * z2 + kLogSeries[0];
  return k + z * p;
}

// |x| < 1000. x = k + r with r in [-1/2, 1/2]; adding 1.5 * 2^52 rounds to an integer and leaves it in the
// low bits.
inline double exp2(double x) {
  const double shifted = x + 6755399441055744.0;
  const double r = x - (shifted - 6755399441055744.0);
  const double scale = std::bit_cast<double>((std::bit_cast<std::uint64_t>(shifted) + 1023u) << 52);
  double p = kExpSeries[12];
  p = p * r + kExpSeries[11];
  p = p * r + kExpSeries[10];
  p = p * r + kExpSeries[9];
  p = p * r + kExpSeries[8];
  p = p * r + kExpSeries[7];
  p = p * r + kExpSeries[6];
  p = p * r + kExpSeries[5];
  p = p * r + kExpSeries[4];
  p = p * r + kExpSeries[3];
  p = p * r + kExpSeries[2];
  p = p * r + kExpSeries[1];
  p = p * r + kExpSeries[0];
  return p * scale;
}

}  // namespace lodestone::det
