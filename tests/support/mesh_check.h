#pragma once
// What every tile mesh must be, and a rasteriser that shares no code with the mesher.

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <map>
#include <set>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "kernels/types/tin_mesh.h"

namespace lodestone::test {

inline std::int64_t area2_of(const TinMesh& m, std::size_t t) {
  const TinVertex &a = m.vertices[m.triangles[3 * t]], &b = m.vertices[m.triangles[3 * t + 1]],
                  &c = m.vertices[m.triangles[3 * t + 2]];
  return static_cast<std::int64_t>(b.row - a.row) * (c.col - a.col) -
         static_cast<std::int64_t>(b.col - a.col) * (c.row - a.row);
}

// Empty when the top surface is conforming, counter-clockwise, without degenerate triangles, and covers the
// tile exactly once (has_holes: only within it); else what is wrong.
inline std::string mesh_fault(const TinMesh& m, bool has_holes = false) {
  std::map<std::pair<std::uint32_t, std::uint32_t>, int> edges;
  std::set<std::pair<int, int>> places;
  for (std::size_t v = 0; v < m.top_vertices; ++v) {
    const TinVertex& p = m.vertices[v];
    if (p.col < 0 || p.row < 0 || p.col >= m.cols || p.row >= m.rows) return "vertex outside the tile";
    if (!places.emplace(p.col, p.row).second) return "two vertices on one post";
  }
  std::int64_t area = 0;
  for (std::size_t t = 0; t < m.top_triangles; ++t) {
    if (area2_of(m, t) <= 0) return "flipped or flat triangle " + std::to_string(t);
    area += area2_of(m, t);
    for (std::size_t i = 0; i < 3; ++i) {
      if (++edges[{m.triangles[3 * t + i], m.triangles[3 * t + (i + 1) % 3]}] > 1)
        return "edge used twice in one direction";
    }
  }
  for (const auto& [edge, count] : edges) {
    if (edges.count({edge.second, edge.first}) != 0) continue;
    const TinVertex &p = m.vertices[edge.first], &q = m.vertices[edge.second];
    const bool on_border = (p.col == q.col && (p.col == 0 || p.col == m.cols - 1)) ||
                           (p.row == q.row && (p.row == 0 || p.row == m.rows - 1));
    if (!on_border && !has_holes) return "open edge inside the tile";
  }
  const std::int64_t whole = 2 * static_cast<std::int64_t>(m.cols - 1) * (m.rows - 1);
  if (has_holes ? area > whole : area != whole)
    return "area " + std::to_string(area) + " of " + std::to_string(whole);
  return "";
}

// Largest and root mean square difference between mesh and heights (cols * rows), by barycentric coordinates
// in long double.
inline std::array<double, 2> rasterised_error(const TinMesh& m, std::span<const float> heights) {
  std::vector<double> error(heights.size(), -1);
  for (std::size_t t = 0; t < m.top_triangles; ++t) {
    const TinVertex &a = m.vertices[m.triangles[3 * t]], &b = m.vertices[m.triangles[3 * t + 1]],
                    &c = m.vertices[m.triangles[3 * t + 2]];
    const auto cross = [](const TinVertex& p, const TinVertex& q, int col, int row) {
      return static_cast<std::int64_t>(q.row - p.row) * (col - p.col) -
             static_cast<std::int64_t>(q.col - p.col) * (row - p.row);
    };
    for (int row = std::min({a.row, b.row, c.row}); row <= std::max({a.row, b.row, c.row}); ++row) {
      for (int col = std::min({a.col, b.col, c.col}); col <= std::max({a.col, b.col, c.col}); ++col) {
        const std::int64_t wa = cross(b, c, col, row), wb = cross(c, a, col, row), wc = cross(a, b, col, row);
        if (wa < 0 || wb < 0 || wc < 0) continue;
        const long double z =
            (static_cast<long double>(wa) * a.height_m + static_cast<long double>(wb) * b.height_m +
             static_cast<long double>(wc) * c.height_m) /
            (wa + wb + wc);
        const std::size_t at =
            static_cast<std::size_t>(row) * static_cast<std::size_t>(m.cols) + static_cast<std::size_t>(col);
        error[at] =
            std::max(error[at], static_cast<double>(std::abs(z - static_cast<long double>(heights[at]))));
      }
    }
  }
  double worst = 0, sum2 = 0;
  std::size_t count = 0;
  for (const double e : error) {
    if (e < 0) continue;
    worst = std::max(worst, e);
    sum2 += e * e;
    ++count;
  }
  return {worst, count > 0 ? std::sqrt(sum2 / static_cast<double>(count)) : 0};
}

// (along, height) of the vertices on one side, in global posts.
inline std::vector<std::pair<std::int64_t, float>> side_of(const TinMesh& m,
                                                           const std::vector<std::uint32_t>& side,
                                                           bool is_vertical) {
  std::vector<std::pair<std::int64_t, float>> result;
  for (const std::uint32_t v : side) {
    const TinVertex& p = m.vertices[v];
    result.emplace_back(is_vertical ? m.j0 + p.row : m.i0 + p.col, p.height_m);
  }
  return result;
}

}  // namespace lodestone::test
