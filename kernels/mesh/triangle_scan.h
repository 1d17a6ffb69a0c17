#pragma once
// Scan of the posts under one triangle: worst error, its post, and the sum of squared errors. The inner loop
// of the TIN.

#include <cstdint>

namespace lodestone {

// Heights as the scan reads them: row r starts at heights_m + r * stride; NaN posts are skipped (vertices,
// locked and void posts). kScanPadding floats behind the last post must be readable.
struct ScanField {
  const float* heights_m = nullptr;
  std::int64_t stride = 0;
};
inline constexpr int kScanPadding = 8;

struct ScanPoint {
  std::int32_t col = 0, row = 0;
  double height_m = 0;
};

struct ScanResult {
  double error_m = 0;  // largest |plane - height|, 0 when nothing was counted
  std::int32_t col = -1,
               row = -1;  // its post; of equal errors the first in row-major order; -1 when error_m is 0
  double sum2_m2 = 0;     // sum of squared errors
};

// Posts inside or on the border of triangle abc (any orientation, not degenerate). The numerators of the
// errors are exact when heights are multiples of 2^-16 below 2^15 m, so equal errors compare equal whichever
// triangle they were measured in; the result has the same bits for every instruction set. Coordinates up to
// 8192.
ScanResult scan_triangle(const ScanField& field, const ScanPoint& a, const ScanPoint& b, const ScanPoint& c);

namespace detail {
// The same with a chosen instruction set, for the test that all give the same bits: 0 baseline, 1 AVX2, 2
// AVX-512 (baseline where the machine lacks it).
ScanResult scan_triangle_at(int width, const ScanField& field, const ScanPoint& a, const ScanPoint& b,
                            const ScanPoint& c);
}  // namespace detail

}  // namespace lodestone
