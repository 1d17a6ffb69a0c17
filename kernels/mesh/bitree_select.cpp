#include "kernels/mesh/bitree_select.h"

#include <cmath>
#include <cstddef>

namespace lodestone {

void cdf22_forward(std::span<std::int32_t> x) {
  const std::size_t count = x.size(), highs = count / 2, lows = count - highs;
  std::vector<std::int32_t> low(lows), high(highs);
  for (std::size_t k = 0; k < highs; ++k) {
    const std::int32_t right = 2 * k + 2 < count ? x[2 * k + 2] : x[2 * k];
    high[k] = x[2 * k + 1] - ((x[2 * k] + right) >> 1);
  }
  for (std::size_t k = 0; k < lows; ++k) {
    const std::int32_t before = k > 0 ? high[k - 1] : high[0];
    const std::int32_t after = k < highs ? high[k] : high[highs - 1];
    low[k] = x[2 * k] + ((before + after + 2) >> 2);
  }
  for (std::size_t k = 0; k < lows; ++k) x[k] = low[k];
  for (std::size_t k = 0; k < highs; ++k) x[lows + k] = high[k];
}

namespace {

// Columns are lifted eight at a time: a column alone would miss the cache at every post.
void lift_columns(std::span<std::int32_t> grid, int stride, int size) {
  const int highs = size / 2, lows = size - highs;
  std::vector<std::int32_t> copy(static_cast<std::size_t>(size) * static_cast<std::size_t>(size));
  const auto row_in = [&](int r) { return grid.data() + static_cast<std::ptrdiff_t>(r) * stride; };
  const auto row_of = [&](int r) { return copy.data() + static_cast<std::ptrdiff_t>(r) * size; };
  for (int k = 0; k < highs; ++k) {
    const std::int32_t *above = row_in(2 * k), *at = row_in(2 * k + 1), *below = row_in(2 * k + 2 < size ? 2 * k + 2 : 2 * k);
    std::int32_t* out = row_of(lows + k);
    for (int c = 0; c < size; ++c) out[c] = at[c] - ((above[c] + below[c]) >> 1);
  }
  for (int k = 0; k < lows; ++k) {
    const std::int32_t *before = row_of(lows + (k > 0 ? k - 1 : 0)), *after = row_of(lows + (k < highs ? k : highs - 1)), *at = row_in(2 * k);
    std::int32_t* out = row_of(k);
    for (int c = 0; c < size; ++c) out[c] = at[c] + ((before[c] + after[c] + 2) >> 2);
  }
  for (int r = 0; r < size; ++r) {
    for (int c = 0; c < size; ++c) row_in(r)[c] = row_of(r)[c];
  }
}

void lift_rows(std::span<std::int32_t> grid, int stride, int size) {
  const int highs = size / 2, lows = size - highs;
  std::vector<std::int32_t> high(static_cast<std::size_t>(highs)), low(static_cast<std::size_t>(lows));
  for (int r = 0; r < size; ++r) {
    std::int32_t* x = grid.data() + static_cast<std::ptrdiff_t>(r) * stride;
    const auto at = [](std::vector<std::int32_t>& v, int k) -> std::int32_t& { return v[static_cast<std::size_t>(k)]; };
    for (int k = 0; k < highs; ++k) at(high, k) = x[2 * k + 1] - ((x[2 * k] + (2 * k + 2 < size ? x[2 * k + 2] : x[2 * k])) >> 1);
    for (int k = 0; k < lows; ++k) at(low, k) = x[2 * k] + ((at(high, k > 0 ? k - 1 : 0) + at(high, k < highs ? k : highs - 1) + 2) >> 2);
    for (int k = 0; k < lows; ++k) x[k] = at(low, k);
    for (int k = 0; k < highs; ++k) x[lows + k] = at(high, k);
  }
}

}  // namespace

void cdf22_forward_2d(std::span<std::int32_t> grid, int stride, int size) {
  lift_rows(grid, stride, size);
  lift_columns(grid, stride, size);
}

std::vector<std::uint8_t> select_by_wavelet(std::span<const std::int32_t> q, int n, int levels, double max_coefficient) {
  const int side = (1 << n) + 1;
  std::vector<std::int32_t> grid(q.begin(), q.end());
  std::vector<std::uint8_t> kept(q.size(), 1), finer, groups;
  int size = side;
  for (int level = 1; level <= levels; ++level) {
    cdf22_forward_2d(grid, side, size);
    const int highs = size / 2, lows = size - highs, finer_groups = size;
    const auto is_small = [&](int r, int c) {
      return std::abs(static_cast<double>(grid[static_cast<std::size_t>(r) * static_cast<std::size_t>(side) + static_cast<std::size_t>(c)])) <= max_coefficient;
    };
    groups.assign(static_cast<std::size_t>(lows) * static_cast<std::size_t>(lows), 0);
    for (int r = 0; r < lows; ++r) {
      for (int c = 0; c < lows; ++c) {
        // A coefficient that the last row or column lacks counts as 0.
        bool shrinks = (c >= highs || is_small(r, lows + c)) && (r >= highs || is_small(lows + r, c)) &&
                       (r >= highs || c >= highs || is_small(lows + r, lows + c));
        for (int child = 0; shrinks && level > 1 && child < 4; ++child) {
          const int cr = 2 * r + child / 2, cc = 2 * c + child % 2;
          if (cr < finer_groups && cc < finer_groups) shrinks = finer[static_cast<std::size_t>(cr * finer_groups + cc)] != 0;
        }
        if (!shrinks) continue;
        groups[static_cast<std::size_t>(r * lows + c)] = 1;
        // Its children shrank already: of them only the north-west posts are left.
        const int step = 1 << (level - 1);
        for (int child = 1; child < 4; ++child) {
          const int row = (2 * r + child / 2) * step, col = (2 * c + child % 2) * step;
          if (row < side && col < side) kept[static_cast<std::size_t>(row) * static_cast<std::size_t>(side) + static_cast<std::size_t>(col)] = 0;
        }
      }
    }
    finer.swap(groups);
    size = lows;
  }
  return kept;
}

void select_edge(std::span<const double> heights_m, std::span<const double> quantised_m, std::span<std::uint8_t> kept, double tolerance_m) {
  const std::size_t width = heights_m.size() - 1;
  std::vector<double> value(heights_m.size());
  kept[0] = kept[width] = 1;
  value[0] = quantised_m[0];
  value[width] = quantised_m[width];
  for (std::size_t s = width / 2; s >= 1; s /= 2) {
    for (std::size_t k = s; k < width; k += 2 * s) {
      const double mean = (value[k - s] + value[k + s]) / 2;
      if (std::abs(mean - heights_m[k]) > tolerance_m) kept[k] = 1;
      value[k] = kept[k] != 0 ? quantised_m[k] : mean;
    }
  }
}

}  // namespace lodestone
