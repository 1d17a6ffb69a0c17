#pragma once
// Which posts the Bitree keeps: the wavelet rule and its transform, the bounded rule, the edge rule.

#include <cstdint>
#include <span>
#include <vector>

namespace lodestone {

// One reversible CDF(2,2) step (JPEG 2000 5/3, floor rounding) of x in place: lows (even samples) first, then highs. Whole-sample symmetric
// extension; at least 2 samples. Source: Abasolo sec. 3.1, CDF(2,2); floor, so that a height offset changes no coefficient.
void cdf22_forward(std::span<std::int32_t> x);

// The same over rows then columns of the top-left size * size block of a square of side `stride`: quadrants LL HL / LH HH.
void cdf22_forward_2d(std::span<std::int32_t> grid, int stride, int size);

// side * side bytes, 1 = kept: posts of groups that the coefficients allow to shrink to their north-west post are dropped. Recursive
// reading of the paper's condition 2: all descendants shrink. max_coefficient on the lattice, `<=`. levels in 1..n.
std::vector<std::uint8_t> select_by_wavelet(std::span<const std::int32_t> q, int n, int levels, double max_coefficient);

// One tile edge: 2^n + 1 heights of the tile (metres) and their lattice values (metres, quantised). kept: 1 on entry = certain; on return
// every post that misses the mean of its parents' values by more than tolerance_m too. Both ends become kept.
void select_edge(std::span<const double> heights_m, std::span<const double> quantised_m, std::span<std::uint8_t> kept, double tolerance_m);

}  // namespace lodestone
