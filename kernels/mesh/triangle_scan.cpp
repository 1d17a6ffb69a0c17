// Fixed arithmetic: eight lanes of doubles whatever the machine has, + - * only in the loop, reductions in
// one order.

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

using Scan = ScanResult (*)(const ScanField&, const ScanPoint&, const ScanPoint&, const ScanPoint&);

ScanResult scan_plain(const ScanField& field, const ScanPoint& a, const ScanPoint& b, const ScanPoint& c) {
#include "kernels/mesh/triangle_scan_body.inc"
}

#if defined(__x86_64__)
[[gnu::target("avx2")]] ScanResult scan_avx2(const ScanField& field, const ScanPoint& a, const ScanPoint& b,
                                             const ScanPoint& c) {
#include "kernels/mesh/triangle_scan_body.inc"
}
[[gnu::target("avx512f,avx512dq,avx512vl,prefer-vector-width=512")]] ScanResult scan_avx512(
    const ScanField& field, const ScanPoint& a, const ScanPoint& b, const ScanPoint& c){
#include "kernels/mesh/triangle_scan_body.inc"
} Scan choose_scan() {
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512vl")) {
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
ScanResult scan_triangle_at(int width, const ScanField& field, const ScanPoint& a, const ScanPoint& b,
                            const ScanPoint& c) {
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
