#include "kernels/mesh/tile_border.h"

#include <cmath>
#include <utility>

namespace lodestone {

std::vector<std::int32_t> simplify_edge(std::span<const float> heights_m,
                                        std::span<const std::uint8_t> is_required,
                                        std::span<const std::uint8_t> is_void, double tolerance_m) {
  const auto count = static_cast<std::int32_t>(heights_m.size());
  const auto height = [&](std::int32_t k) {
    return static_cast<double>(heights_m[static_cast<std::size_t>(k)]);
  };
  std::vector<std::uint8_t> keep(heights_m.size(), 0);
  std::vector<std::pair<std::int32_t, std::int32_t>> stack;
  std::int32_t from = 0;
  for (std::int32_t k = 1; k < count; ++k) {
    if (k + 1 < count && (is_required.empty() || !is_required[static_cast<std::size_t>(k)])) continue;
    stack.emplace_back(from, k);
    from = k;
  }
  while (!stack.empty()) {
    const auto [i, j] = stack.back();
    stack.pop_back();
    keep[static_cast<std::size_t>(i)] = keep[static_cast<std::size_t>(j)] = 1;
    // Errors times the length, which is exact for heights of few bits.
    const double length = j - i, rise = height(j) - height(i);
    double worst = 0;
    std::int32_t at = -1;
    for (std::int32_t k = i + 1; k < j; ++k) {
      if (!is_void.empty() && is_void[static_cast<std::size_t>(k)]) continue;
      const double error = std::abs(length * (height(k) - height(i)) - rise * (k - i));
      if (error > worst) {
        worst = error;
        at = k;
      }
    }
    if (at < 0 || worst / length <= tolerance_m) continue;
    stack.emplace_back(i, at);
    stack.emplace_back(at, j);
  }
  std::vector<std::int32_t> kept;
  for (std::int32_t k = 0; k < count; ++k) {
    if (keep[static_cast<std::size_t>(k)]) kept.push_back(k);
  }
  return kept;
}

}  // namespace lodestone
