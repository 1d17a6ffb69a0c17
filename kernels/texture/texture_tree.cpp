#include "kernels/texture/texture_tree.h"

#include <algorithm>
#include <cassert>
#include <cstdlib>
#include <utility>

#include "kernels/mesh/bitree_lattice.h"

namespace lodestone {

namespace {

// A triangle by the middle of its hypotenuse in half pixels, and its direction (bitree_lattice.h).
struct Place {
  int row2, col2, dir;
};
// Half the side of the squares of a level, in half pixels: 2^n pixels have 2^(n + 1) half pixels.
int half2(int n, int level) { return half_side(n + 1, level); }

Place child_of(const Place& place, int n, int level, int which) {
  const int dir = which == 0 ? first_child_dir(place.dir, level) : second_child_dir(place.dir, level);
  const int s = half2(n, level + 1);
  return {place.row2 - kDirRow[dir] * s, place.col2 - kDirCol[dir] * s, dir};
}

Place place_of(int n, int level, std::uint32_t index) {
  Place place{1 << n, 1 << n, kRootDir[index >> level]};
  for (int l = 0; l < level; ++l) place = child_of(place, n, l, static_cast<int>(index >> (level - 1 - l) & 1));
  return place;
}

// Area per class in half pixels, classes ascending.
using Areas = std::vector<std::pair<std::uint8_t, std::uint32_t>>;

class Builder {
 public:
  Builder(TextureTree& tree, std::span<const std::uint8_t> classes, double share) : tree_(tree), pixels_(classes), share_(share), areas_(static_cast<std::size_t>(2 * tree.n) + 2) {
    for (auto& pair : areas_) pair = {Areas{}, Areas{}};
  }

  const Areas& visit(const Place& place, int level, std::uint32_t index) {
    Areas& areas = index % 2 == 0 ? areas_[static_cast<std::size_t>(level)].first : areas_[static_cast<std::size_t>(level)].second;
    areas.clear();
    if (level == 2 * tree_.n) {
      const int row = place.row2 / 2, col = place.col2 / 2;
      if (row < tree_.height && col < tree_.width) areas.push_back({pixels_[static_cast<std::size_t>(row) * static_cast<std::size_t>(tree_.width) + static_cast<std::size_t>(col)], 1});
    } else {
      const Areas& first = visit(child_of(place, tree_.n, level, 0), level + 1, 2 * index);
      const Areas& second = visit(child_of(place, tree_.n, level, 1), level + 1, 2 * index + 1);
      auto a = first.begin(), b = second.begin();
      while (a != first.end() || b != second.end()) {
        if (b == second.end() || (a != first.end() && a->first < b->first)) {
          areas.push_back(*a++);
        } else if (a == first.end() || b->first < a->first) {
          areas.push_back(*b++);
        } else {
          areas.push_back({a->first, a->second + b->second});
          ++a, ++b;
        }
      }
    }
    std::uint64_t total = 0;
    std::pair<std::uint8_t, std::uint32_t> best{0, 0};
    for (const auto& entry : areas) {
      total += entry.second;
      if (entry.second > best.second) best = entry;
    }
    const auto l = static_cast<std::size_t>(level);
    tree_.classes[l][index] = best.first;
    tree_.is_uniform[l][index] = total == 0 ? 2 : level == 2 * tree_.n || static_cast<double>(best.second) >= share_ * static_cast<double>(total) ? 1 : 0;
    return areas;
  }

 private:
  TextureTree& tree_;
  std::span<const std::uint8_t> pixels_;
  double share_;
  std::vector<std::pair<Areas, Areas>> areas_;   // of the two children at hand per level
};

}  // namespace

int texture_tree_n(int width, int height) {
  int n = 0;
  while (1 << n < std::max(width, height)) ++n;
  return n;
}

TextureTree build_texture_tree(std::span<const std::uint8_t> classes, int width, int height, double uniform_share) {
  assert(width >= 1 && height >= 1 && classes.size() == static_cast<std::size_t>(width) * static_cast<std::size_t>(height));
  TextureTree tree;
  tree.n = texture_tree_n(width, height);
  tree.width = width;
  tree.height = height;
  for (int level = 0; level <= 2 * tree.n; ++level) {
    tree.classes.emplace_back(std::size_t{2} << level, 0);
    tree.is_uniform.emplace_back(std::size_t{2} << level, 0);
  }
  Builder builder(tree, classes, uniform_share);
  for (std::uint32_t root = 0; root < 2; ++root) builder.visit({1 << tree.n, 1 << tree.n, kRootDir[root]}, 0, root);
  // A root without weight cannot be: each half of the square touches the north-west pixel. Elsewhere the parent's class holds.
  for (std::size_t level = 0; level < tree.classes.size(); ++level) {
    for (std::size_t k = 0; k < tree.classes[level].size(); ++k) {
      if (tree.is_uniform[level][k] != 2) continue;
      tree.is_uniform[level][k] = 1;
      if (level > 0) tree.classes[level][k] = tree.classes[level - 1][k / 2];
    }
  }
  return tree;
}

TextureTriangles count_texture_triangles(const TextureTree& tree) {
  TextureTriangles count;
  std::vector<std::uint32_t> frontier{0, 1}, next;
  for (std::size_t level = 0; !frontier.empty(); ++level) {
    for (const std::uint32_t k : frontier) {
      ++count.visited;
      if (tree.is_uniform[level][k] != 0) {
        ++count.leaves;
      } else {
        next.push_back(2 * k);
        next.push_back(2 * k + 1);
      }
    }
    frontier = std::exchange(next, {});
  }
  return count;
}

void paint_texture_triangle(int n, int level, std::uint32_t index, std::uint8_t value, std::span<std::uint8_t> pixels, int width, int height) {
  const Place place = place_of(n, level, index);
  // A pixel is tested a quarter of its side north of its centre: that point lies in its northern half whichever diagonal cuts it, and
  // on no triangle's edge. Everything in quarter pixels.
  const int s = 2 * half2(n, level), dr = kDirRow[place.dir] * s, dc = kDirCol[place.dir] * s;
  const int er = -dc, ec = dr;   // m -> p
  const int m_row = 2 * place.row2, m_col = 2 * place.col2;
  const int row_min = m_row + std::min({dr, er, -er}), row_max = m_row + std::max({dr, er, -er});
  const int col_min = m_col + std::min({dc, ec, -ec}), col_max = m_col + std::max({dc, ec, -ec});
  const std::int64_t size2 = static_cast<std::int64_t>(dr) * dr + static_cast<std::int64_t>(dc) * dc;
  for (int row = row_min / 4; row < std::min(height, (row_max + 3) / 4); ++row) {
    for (int col = col_min / 4; col < std::min(width, (col_max + 3) / 4); ++col) {
      // Coordinates along m -> apex and m -> p, times the length of both: inside are 0 < u, |v| < size2 - u.
      const std::int64_t y = 4 * row + 1 - m_row, x = 4 * col + 2 - m_col;
      const std::int64_t u = y * dr + x * dc, v = std::abs(y * er + x * ec);
      if (u > 0 && u + v < size2) pixels[static_cast<std::size_t>(row) * static_cast<std::size_t>(width) + static_cast<std::size_t>(col)] = value;
    }
  }
}

}  // namespace lodestone
