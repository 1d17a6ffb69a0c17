#pragma once
// PostWindow: an inclusive rectangle of posts in the global index space of one level (x east, y south).

#include <compare>
#include <cstdint>

namespace lodestone {

struct PostWindow {
  std::int64_t i0 = 0;  // first column
  std::int64_t j0 = 0;  // first row
  std::int64_t i1 = 0;  // last column, inclusive
  std::int64_t j1 = 0;  // last row, inclusive

  std::int64_t width() const { return i1 - i0 + 1; }
  std::int64_t height() const { return j1 - j0 + 1; }
  bool is_empty() const { return i1 < i0 || j1 < j0; }
  bool contains(std::int64_t i, std::int64_t j) const { return i >= i0 && i <= i1 && j >= j0 && j <= j1; }
  bool operator==(const PostWindow&) const = default;
};

// floor(a / 2^k) and ceil(a / 2^k) for any sign, k in 0..62.
inline std::int64_t floor_shift(std::int64_t a, int k) { return a >> k; }
inline std::int64_t ceil_shift(std::int64_t a, int k) { return -((-a) >> k); }

// The same ground `depth` levels finer: vertex (i, j) becomes (i 2^depth, j 2^depth).
inline PostWindow finer(const PostWindow& w, int depth) {
  return {w.i0 << depth, w.j0 << depth, w.i1 << depth, w.j1 << depth};
}

// Whole-sample mirror of index i into [lo, hi] (…, lo+1, lo, lo+1, …), then clamped for far-away indices.
inline std::int64_t mirrored(std::int64_t i, std::int64_t lo, std::int64_t hi) {
  if (i < lo) i = 2 * lo - i;
  if (i > hi) i = 2 * hi - i;
  return i < lo ? lo : (i > hi ? hi : i);
}

}  // namespace lodestone
