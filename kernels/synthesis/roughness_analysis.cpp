// One step of the CDF(2,2) analysis by lifting, float32 in the printed order: along x first, then along y.
// Source: SPEC-SYNTHESIS section 2.

#include <algorithm>
#include <cassert>

#include "kernels/synthesis/roughness.h"

namespace lodestone {
namespace {

// Whole-sample mirror of i into [lo, hi], as often as it takes: worlds of one or two posts reflect more than
// once.
std::int64_t reflected(std::int64_t i, std::int64_t lo, std::int64_t hi) {
  if (lo == hi) return lo;
  while (i < lo || i > hi) i = i < lo ? 2 * lo - i : 2 * hi - i;
  return i;
}

// Where the fine posts 2(c0-1) .. 2(c1+1) of one direction are found, counted from `origin`; [0] is post
// 2(c0-1).
std::vector<std::size_t> sources(std::int64_t c0, std::int64_t c1, std::int64_t lo, std::int64_t hi,
                                 std::int64_t origin) {
  std::vector<std::size_t> at;
  at.reserve(static_cast<std::size_t>(2 * (c1 - c0) + 5));
  for (std::int64_t i = 2 * (c0 - 1); i <= 2 * (c1 + 1); ++i) {
    at.push_back(static_cast<std::size_t>(reflected(i, lo, hi) - origin));
  }
  return at;
}

// x[n] -> coarse c[I] = x[2I] + (d[I-1] + d[I]) / 4 and detail d[I] = x[2I+1] - (x[2I] + x[2I+2]) / 2 for one
// row. `at` as made by sources(); scratch: 2n + 3 + n + 1 floats.
void lift_row(const float* x, const std::vector<std::size_t>& at, std::size_t n, float* scratch, float* low,
              float* high) {
  float* post = scratch;
  float* d = scratch + 2 * n + 3;
  for (std::size_t i = 0; i < 2 * n + 3; ++i) post[i] = x[at[i]];
  for (std::size_t i = 0; i <= n; ++i) d[i] = post[2 * i + 1] - (post[2 * i] + post[2 * i + 2]) * 0.5F;
  for (std::size_t i = 0; i < n; ++i) {
    low[i] = post[2 * i + 2] + (d[i] + d[i + 1]) * 0.25F;
    high[i] = d[i + 1];
  }
}

// The same for validity: a coefficient is void when some post under its filter is.
void void_row(const std::uint8_t* x, const std::vector<std::size_t>& at, std::size_t n, std::uint8_t* low,
              std::uint8_t* high) {
  for (std::size_t i = 0; i < n; ++i) {
    high[i] = x[at[2 * i + 2]] | x[at[2 * i + 3]] | x[at[2 * i + 4]];
    low[i] = x[at[2 * i]] | x[at[2 * i + 1]] | high[i];
  }
}

// Voids of the whole step; vertical half of the OR included.
void mark_voids(const HeightGrid& fine, const PostWindow& need, const std::vector<std::size_t>& columns,
                const std::vector<std::size_t>& rows, AnalysisStep& step) {
  const auto n = static_cast<std::size_t>(step.coarse.width());
  const auto m = static_cast<std::size_t>(step.coarse.height());
  const auto fine_rows = static_cast<std::size_t>(need.height());
  std::vector<std::uint8_t> low(fine_rows * n), high(fine_rows * n);
  for (std::size_t r = 0; r < fine_rows; ++r) {
    const auto first = fine.index(fine.window.i0, need.j0 + static_cast<std::int64_t>(r));
    void_row(fine.is_void.data() + first, columns, n, low.data() + r * n, high.data() + r * n);
  }
  step.low_void.assign(n * m, 0);
  bool any = false;
  for (std::size_t j = 0; j < m; ++j) {
    const std::size_t* at = rows.data() + 2 * j;
    for (std::size_t i = 0; i < n; ++i) {
      const auto of = [&](const std::vector<std::uint8_t>& v, int k) { return v[at[k] * n + i]; };
      const std::uint8_t low_inner = of(low, 2) | of(low, 3) | of(low, 4);
      const std::uint8_t high_inner = of(high, 2) | of(high, 3) | of(high, 4);
      const std::uint8_t low_all = low_inner | of(low, 0) | of(low, 1);
      step.low_void[j * n + i] = low_all != 0;
      step.detail_void[0][j * n + i] = (high_inner | of(high, 0) | of(high, 1)) != 0;
      step.detail_void[1][j * n + i] = low_inner != 0;
      step.detail_void[2][j * n + i] = high_inner != 0;
      any = any || low_all != 0;
    }
  }
  if (!any) step.low_void.clear();
}

// Details whose own fine post does not exist.
void drop_outside(const PostWindow& world, AnalysisStep& step) {
  const PostWindow& c = step.coarse;
  const std::int64_t n = c.width();
  for (std::size_t t = 0; t < 3; ++t) {
    const std::int64_t odd_x = t != 1, odd_y = t != 0;
    if (world.contains(2 * c.i0 + odd_x, 2 * c.j0 + odd_y) &&
        world.contains(2 * c.i1 + odd_x, 2 * c.j1 + odd_y))
      continue;
    for (std::int64_t j = c.j0; j <= c.j1; ++j) {
      for (std::int64_t i = c.i0; i <= c.i1; ++i) {
        if (world.contains(2 * i + odd_x, 2 * j + odd_y)) continue;
        const auto at = static_cast<std::size_t>((j - c.j0) * n + (i - c.i0));
        step.detail_m[t][at] = 0;
        step.detail_void[t][at] = 1;
      }
    }
  }
}

}  // namespace

PostWindow analysis_window(const PostWindow& coarse, const PostWindow& world) {
  return {
      std::clamp(2 * coarse.i0 - 2, world.i0, world.i1), std::clamp(2 * coarse.j0 - 2, world.j0, world.j1),
      std::clamp(2 * coarse.i1 + 2, world.i0, world.i1), std::clamp(2 * coarse.j1 + 2, world.j0, world.j1)};
}

AnalysisStep analyse(const HeightGrid& fine, const PostWindow& world, const PostWindow& coarse) {
  const PostWindow need = analysis_window(coarse, world);
  assert(!coarse.is_empty() && "an empty rectangle has no analysis");
  assert(fine.window.contains(need.i0, need.j0) && fine.window.contains(need.i1, need.j1) &&
         "fine posts are missing");
  AnalysisStep step;
  step.coarse = coarse;
  const auto n = static_cast<std::size_t>(coarse.width());
  const auto m = static_cast<std::size_t>(coarse.height());
  step.low_m.resize(n * m);
  for (auto& band : step.detail_m) band.resize(n * m);
  for (auto& band : step.detail_void) band.assign(n * m, 0);

  // Along x: every fine row that is needed.
  const auto columns = sources(coarse.i0, coarse.i1, world.i0, world.i1, fine.window.i0);
  const auto rows = sources(coarse.j0, coarse.j1, world.j0, world.j1, need.j0);
  const auto fine_rows = static_cast<std::size_t>(need.height());
  std::vector<float> low(fine_rows * n), high(fine_rows * n), scratch(3 * n + 4);
  for (std::size_t r = 0; r < fine_rows; ++r) {
    const auto first = fine.index(fine.window.i0, need.j0 + static_cast<std::int64_t>(r));
    lift_row(fine.heights_m.data() + first, columns, n, scratch.data(), low.data() + r * n,
             high.data() + r * n);
  }

  // Along y: d2, d3 of coarse row j - 1 are kept in `above`, those of row j go to `here`.
  std::vector<float> above(2 * n), here(2 * n);
  for (std::size_t j = 0; j <= m; ++j) {
    const std::size_t even = rows[2 * j] * n, odd = rows[2 * j + 1] * n, next = rows[2 * j + 2] * n;
    for (std::size_t i = 0; i < n; ++i) {
      here[i] = low[odd + i] - (low[even + i] + low[next + i]) * 0.5F;
      here[n + i] = high[odd + i] - (high[even + i] + high[next + i]) * 0.5F;
    }
    if (j > 0) {
      const std::size_t out = (j - 1) * n;
      for (std::size_t i = 0; i < n; ++i) {
        step.low_m[out + i] = low[even + i] + (above[i] + here[i]) * 0.25F;
        step.detail_m[0][out + i] = high[even + i] + (above[n + i] + here[n + i]) * 0.25F;
        step.detail_m[1][out + i] = here[i];
        step.detail_m[2][out + i] = here[n + i];
      }
    }
    above.swap(here);
  }

  if (!fine.is_void.empty()) mark_voids(fine, need, columns, rows, step);
  drop_outside(world, step);
  return step;
}

}  // namespace lodestone
