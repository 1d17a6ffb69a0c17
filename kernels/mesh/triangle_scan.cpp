// Fixed arithmetic: eight lanes of doubles whatever the machine has, + - * only in the loop, reductions in one order.

#include "kernels/mesh/triangle_scan.h"

#include <cstring>
#include <utility>

namespace lodestone {
namespace {

using Float8 = float __attribute__((vector_size(32)));
using Double8 = double __attribute__((vector_size(64)));
using Long8 = std::int64_t __attribute__((vector_size(64)));

// Column of an edge at successive rows: floor in `whole`, the rest in `part` / `rows`. Exact.
struct EdgeWalk {
  std::int32_t whole, part, step_whole, step_part, rows;

  EdgeWalk(const ScanPoint& from, const ScanPoint& to) : whole(from.col), part(0), rows(to.row - from.row) {
    const std::int32_t d = to.col - from.col;
    if (rows == 0) {
      step_whole = step_part = 0;
      rows = 1;
      return;
    }
    step_whole = d / rows;
    step_part = d % rows;
    if (step_part < 0) {
      step_part += rows;
      --step_whole;
    }
  }
  std::int32_t floor() const { return whole; }
  std::int32_t ceil() const { return whole + (part > 0 ? 1 : 0); }
  void next() {
    whole += step_whole;
    part += step_part;
    if (part >= rows) {
      part -= rows;
      ++whole;
    }
  }
};

[[gnu::always_inline]] inline ScanResult scan_body(const ScanField& field, const ScanPoint& a, const ScanPoint& b,
                                                   const ScanPoint& c) {
  const ScanPoint* top = &a;
  const ScanPoint* mid = &b;
  const ScanPoint* low = &c;
  const auto below = [](const ScanPoint* p, const ScanPoint* q) {
    return p->row > q->row || (p->row == q->row && p->col > q->col);
  };
  if (below(top, mid)) std::swap(top, mid);
  if (below(mid, low)) std::swap(mid, low);
  if (below(top, mid)) std::swap(top, mid);

  // Plane relative to `top`, multiplied by twice the signed area: area2 * z = slope_x * dx + slope_y * dy.
  const double mx = mid->col - top->col, my = mid->row - top->row;
  const double lx = low->col - top->col, ly = low->row - top->row;
  const double mz = mid->height_m - top->height_m, lz = low->height_m - top->height_m;
  const double area2 = mx * ly - lx * my;
  const double slope_x = mz * ly - lz * my;
  const double slope_y = mx * lz - lx * mz;
  const bool is_mid_east = area2 > 0;

  const Double8 lane = {0, 1, 2, 3, 4, 5, 6, 7};
  const Long8 lane_index = {0, 1, 2, 3, 4, 5, 6, 7};
  const Double8 ramp = slope_x * lane;
  const Long8 sign_off = Long8{} + 0x7fffffffffffffff;
  const double top_height = top->height_m;
  Double8 best = {}, sum = {};
  Long8 best_at = {};

  EdgeWalk long_edge(*top, *low);
  EdgeWalk short_edge = my > 0 ? EdgeWalk(*top, *mid) : EdgeWalk(*mid, *low);
  for (std::int32_t row = top->row; row <= low->row; ++row) {
    if (row == mid->row && my > 0) short_edge = EdgeWalk(*mid, *low);
    const std::int32_t first = is_mid_east ? long_edge.ceil() : short_edge.ceil();
    const std::int32_t last = is_mid_east ? short_edge.floor() : long_edge.floor();
    const float* heights = field.heights_m + row * field.stride;
    const double row_base = slope_y * static_cast<double>(row - top->row);
    for (std::int32_t col = first; col <= last; col += 8) {
      Float8 h32;
      std::memcpy(&h32, heights + col, sizeof h32);
      const Double8 h = __builtin_convertvector(h32, Double8);
      const double base = row_base + slope_x * static_cast<double>(col - top->col);
      const Double8 numerator = (base + ramp) - area2 * (h - top_height);
      const Long8 is_in = (lane_index <= static_cast<std::int64_t>(last - col)) & (numerator == numerator);
      const Double8 magnitude = (Double8)(((Long8)numerator & sign_off) & is_in);
      const Long8 is_better = magnitude > best;
      best = is_better ? magnitude : best;
      best_at = is_better ? lane_index + (static_cast<std::int64_t>(row) << 32 | col) : best_at;
      sum += magnitude * magnitude;
    }
    long_edge.next();
    short_edge.next();
  }

  double most = 0;
  std::int64_t at = -1;
  for (int i = 0; i < 8; ++i) {
    if (best[i] > most || (best[i] == most && most > 0 && best_at[i] < at)) {
      most = best[i];
      at = best_at[i];
    }
  }
  const double total = ((sum[0] + sum[4]) + (sum[2] + sum[6])) + ((sum[1] + sum[5]) + (sum[3] + sum[7]));
  const double area = area2 < 0 ? -area2 : area2;
  ScanResult result;
  if (at >= 0) {
    result.error_m = most / area;
    result.col = static_cast<std::int32_t>(at & 0xffffffff);
    result.row = static_cast<std::int32_t>(at >> 32);
    result.sum2_m2 = total / (area * area);
  }
  return result;
}

using Scan = ScanResult (*)(const ScanField&, const ScanPoint&, const ScanPoint&, const ScanPoint&);

ScanResult scan_plain(const ScanField& field, const ScanPoint& a, const ScanPoint& b, const ScanPoint& c) {
  return scan_body(field, a, b, c);
}

#if defined(__x86_64__)
[[gnu::target("avx2")]] ScanResult scan_avx2(const ScanField& field, const ScanPoint& a, const ScanPoint& b,
                                             const ScanPoint& c) {
  return scan_body(field, a, b, c);
}
[[gnu::target("avx512f,avx512dq,avx512vl,prefer-vector-width=512")]] ScanResult scan_avx512(const ScanField& field,
                                                                                            const ScanPoint& a,
                                                                                            const ScanPoint& b,
                                                                                            const ScanPoint& c) {
  return scan_body(field, a, b, c);
}
Scan choose_scan() {
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl")) {
    return scan_avx512;
  }
  return __builtin_cpu_supports("avx2") ? scan_avx2 : scan_plain;
}
#else
Scan choose_scan() { return scan_plain; }
#endif

const Scan kScan = choose_scan();

}  // namespace

ScanResult scan_triangle(const ScanField& field, const ScanPoint& a, const ScanPoint& b, const ScanPoint& c) {
  return kScan(field, a, b, c);
}

namespace detail {
ScanResult scan_triangle_at(int width, const ScanField& field, const ScanPoint& a, const ScanPoint& b, const ScanPoint& c) {
#if defined(__x86_64__)
  if (width == 2 && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl")) {
    return scan_avx512(field, a, b, c);
  }
  if (width == 1 && __builtin_cpu_supports("avx2")) return scan_avx2(field, a, b, c);
#else
  (void)width;
#endif
  return scan_plain(field, a, b, c);
}
}  // namespace detail

}  // namespace lodestone
