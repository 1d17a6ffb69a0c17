#pragma once
// Where the split points of the Bitree lie: levels, hypotenuse ends, apexes, and triangles by midpoint and direction.
// Source: Abasolo sec. 3.2; levels 2j are centres of squares of side 2s, levels 2j + 1 midpoints of their edges, s = 2^(n-1-j).

#include <cstdint>

namespace lodestone {

// A split point. Indices are row * side + col; apex_b is -1 for a point on the tile's edge.
struct SplitPoint {
  int row, col;
  std::int32_t index, end_a, end_b, apex_a, apex_b;
};

// Half the side of the squares of a level (distance from point to apex along an axis).
inline int half_side(int n, int level) { return 1 << (n - 1 - level / 2); }

// Calls visit(SplitPoint) for every point of one level, row by row. Needs 0 <= level < 2n.
template <class Visit>
void for_each_split_point(int n, int level, Visit&& visit) {
  const int width = 1 << n, side = width + 1, s = half_side(n, level);
  const std::int32_t down = s * side;
  if (level % 2 == 0) {
    for (int row = s; row < width; row += 2 * s) {
      for (int col = s; col < width; col += 2 * s) {
        const std::int32_t at = row * side + col;
        const bool is_main = (((row - s) / (2 * s) + (col - s) / (2 * s)) & 1) == 0;   // hypotenuse NW-SE
        const std::int32_t main = down + s, cross = down - s;
        if (is_main) {
          visit(SplitPoint{row, col, at, at - main, at + main, at - cross, at + cross});
        } else {
          visit(SplitPoint{row, col, at, at - cross, at + cross, at - main, at + main});
        }
      }
    }
    return;
  }
  for (int row = 0; row <= width; row += s) {
    const bool is_horizontal = (row / s) % 2 == 0;   // the edge runs along the row
    for (int col = is_horizontal ? s : 0; col <= width; col += 2 * s) {
      const std::int32_t at = row * side + col;
      if (is_horizontal) {
        std::int32_t above = row > 0 ? at - down : -1, below = row < width ? at + down : -1;
        if (above < 0) above = below, below = -1;
        visit(SplitPoint{row, col, at, at - s, at + s, above, below});
      } else {
        std::int32_t left = col > 0 ? at - s : -1, right = col < width ? at + s : -1;
        if (left < 0) left = right, right = -1;
        visit(SplitPoint{row, col, at, at - down, at + down, left, right});
      }
    }
  }
}

// A triangle is its hypotenuse's midpoint m and the direction m -> apex, in eighths of a turn, counter-clockwise from east.
// Even levels have odd directions. p lies a quarter turn counter-clockwise from the apex, q opposite to p.
inline constexpr int kDirRow[8] = {0, -1, -1, -1, 0, 1, 1, 1};
inline constexpr int kDirCol[8] = {1, 1, 0, -1, -1, -1, 0, 1};
inline constexpr int kRootDir[2] = {1, 5};   // apex NE, apex SW; both at the centre

// Directions of the children in Sierpinski order: (m, apex, p) first on even levels, (m, q, apex) first on odd ones.
inline int first_child_dir(int dir, int level) { return (dir + (level % 2 == 0 ? 5 : 3)) & 7; }
inline int second_child_dir(int dir, int level) { return (dir + (level % 2 == 0 ? 3 : 5)) & 7; }

}  // namespace lodestone
