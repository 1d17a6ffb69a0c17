// What is done to a finished mesh: measuring, normals, skirts.

#include <algorithm>
#include <array>
#include <cmath>
#include <unordered_map>

#include "kernels/mesh/tin.h"

namespace lodestone {
namespace {

// Columns of one triangle row by row, from its three half-planes; exact integers, one division an edge.
class RowSpans {
 public:
  RowSpans(const TinVertex* const (&corner)[3], std::int32_t top) {
    first_ = std::min({corner[0]->col, corner[1]->col, corner[2]->col});
    last_ = std::max({corner[0]->col, corner[1]->col, corner[2]->col});
    for (int i = 0; i < 3; ++i) {
      const TinVertex& a = *corner[i];
      const TinVertex& b = *corner[(i + 1) % 3];
      // Inside (counter-clockwise, north up): height * (col - a.col) >= width * (row - a.row).
      const std::int64_t height = b.row - a.row, width = b.col - a.col;
      if (height == 0) continue;
      Side& side = sides_[static_cast<std::size_t>(count_++)];
      side.is_first = height > 0;
      side.size = std::abs(height);
      const std::int64_t sign = side.is_first ? 1 : -1;
      const std::int64_t limit = sign * (width * (top - a.row) + height * a.col);
      side.col = floor_div(limit, side.size);
      side.rest = limit - side.col * side.size;
      side.step_col = floor_div(sign * width, side.size);
      side.step_rest = sign * width - side.step_col * side.size;
    }
  }
  std::int64_t first() const {
    std::int64_t col = first_;
    for (int i = 0; i < count_; ++i) {
      const Side& s = sides_[static_cast<std::size_t>(i)];
      if (s.is_first) col = std::max(col, s.col + (s.rest > 0 ? 1 : 0));
    }
    return col;
  }
  std::int64_t last() const {
    std::int64_t col = last_;
    for (int i = 0; i < count_; ++i) {
      const Side& s = sides_[static_cast<std::size_t>(i)];
      if (!s.is_first) col = std::min(col, s.col);
    }
    return col;
  }
  void next() {
    for (int i = 0; i < count_; ++i) {
      Side& s = sides_[static_cast<std::size_t>(i)];
      s.col += s.step_col;
      s.rest += s.step_rest;
      if (s.rest >= s.size) {
        s.rest -= s.size;
        ++s.col;
      }
    }
  }

 private:
  struct Side {
    std::int64_t col, rest, step_col, step_rest, size;  // limit = col + rest / size
    bool is_first;
  };
  static std::int64_t floor_div(std::int64_t n, std::int64_t d) { return n / d - (n % d < 0 ? 1 : 0); }
  std::array<Side, 3> sides_{};
  int count_ = 0;
  std::int64_t first_, last_;
};

}  // namespace

SurfaceError measure_error(const TinMesh& mesh, const PostField& field) {
  std::vector<std::uint8_t> is_counted(
      static_cast<std::size_t>(mesh.cols) * static_cast<std::size_t>(mesh.rows), 0);
  SurfaceError result;
  double sum2 = 0;
  for (std::size_t t = 0; t < mesh.top_triangles; ++t) {
    const TinVertex* corner[3];
    for (std::size_t i = 0; i < 3; ++i) corner[i] = &mesh.vertices[mesh.triangles[3 * t + i]];
    const TinVertex& a = *corner[0];
    const double bx = corner[1]->col - a.col, by = corner[1]->row - a.row,
                 bz = static_cast<double>(corner[1]->height_m) - a.height_m;
    const double cx = corner[2]->col - a.col, cy = corner[2]->row - a.row,
                 cz = static_cast<double>(corner[2]->height_m) - a.height_m;
    const double area2 = bx * cy - cx * by;
    const double slope_x = bz * cy - cz * by, slope_y = bx * cz - cx * bz;
    const std::int32_t top = std::min({corner[0]->row, corner[1]->row, corner[2]->row});
    const std::int32_t bottom = std::max({corner[0]->row, corner[1]->row, corner[2]->row});
    double worst = 0;
    RowSpans spans(corner, top);
    for (std::int32_t row = top; row <= bottom; ++row, spans.next()) {
      const std::int64_t last = spans.last();
      for (std::int64_t col = spans.first(); col <= last; ++col) {
        const auto c = static_cast<std::int32_t>(col);
        std::uint8_t& counted =
            is_counted[static_cast<std::size_t>(row) * static_cast<std::size_t>(mesh.cols) +
                       static_cast<std::size_t>(c)];
        if (counted || field.void_at(c, row)) continue;
        counted = 1;
        const double above_a = static_cast<double>(field.at(c, row)) - a.height_m;
        const double numerator = slope_x * (c - a.col) + slope_y * (row - a.row) - area2 * above_a;
        worst = std::max(worst, std::abs(numerator));
        const double error = numerator / area2;
        sum2 += error * error;
        ++result.posts;
      }
    }
    result.max_m = std::max(result.max_m, worst / std::abs(area2));
  }
  result.rms_m = result.posts > 0 ? std::sqrt(sum2 / static_cast<double>(result.posts)) : 0;
  return result;
}

void set_normals(TinMesh& mesh, const PostField& field, double spacing_x_m, double spacing_y_m) {
  mesh.normals.clear();
  mesh.normals.reserve(3 * mesh.vertices.size());
  for (const TinVertex& v : mesh.vertices) {
    const std::int32_t west = std::max(v.col - 1, -field.halo),
                       east = std::min(v.col + 1, field.cols - 1 + field.halo);
    const std::int32_t north = std::max(v.row - 1, -field.halo),
                       south = std::min(v.row + 1, field.rows - 1 + field.halo);
    const double to_east =
        (static_cast<double>(field.at(east, v.row)) - field.at(west, v.row)) / ((east - west) * spacing_x_m);
    const double to_north = (static_cast<double>(field.at(v.col, north)) - field.at(v.col, south)) /
                            ((south - north) * spacing_y_m);
    const double length = std::sqrt(to_east * to_east + to_north * to_north + 1);
    mesh.normals.push_back(static_cast<float>(-to_east / length));
    mesh.normals.push_back(static_cast<float>(-to_north / length));
    mesh.normals.push_back(static_cast<float>(1 / length));
  }
}

void add_skirt(TinMesh& mesh, float depth_m) {
  mesh.skirt_depth_m = depth_m;
  const std::vector<std::uint32_t> top(
      mesh.triangles.begin(), mesh.triangles.begin() + static_cast<std::ptrdiff_t>(3 * mesh.top_triangles));
  std::unordered_map<std::uint32_t, std::uint32_t> lower;
  const auto lowered = [&](std::uint32_t v) {
    const auto [at, is_new] = lower.try_emplace(v, static_cast<std::uint32_t>(mesh.vertices.size()));
    if (is_new) {
      TinVertex low = mesh.vertices[v];
      low.height_m -= depth_m;
      mesh.vertices.push_back(low);
      for (std::size_t i = 0; i < 3 && !mesh.normals.empty(); ++i)
        mesh.normals.push_back(mesh.normals[3 * v + i]);
    }
    return at->second;
  };
  for (std::size_t k = 0; k < top.size(); ++k) {
    const std::uint32_t a = top[k], b = top[k % 3 == 2 ? k - 2 : k + 1];
    const TinVertex &p = mesh.vertices[a], &q = mesh.vertices[b];
    const bool is_border = (p.col == q.col && (p.col == 0 || p.col == mesh.cols - 1)) ||
                           (p.row == q.row && (p.row == 0 || p.row == mesh.rows - 1));
    if (!is_border) continue;
    const std::uint32_t a_low = lowered(a), b_low = lowered(b);
    mesh.triangles.insert(mesh.triangles.end(), {a_low, b_low, b, a_low, b, a});
    if (!mesh.zones.empty()) mesh.zones.insert(mesh.zones.end(), 2, mesh.zones[k / 3]);
    if (!mesh.blend.empty()) {
      const float at_a = mesh.blend[k], at_b = mesh.blend[k % 3 == 2 ? k - 2 : k + 1];
      mesh.blend.insert(mesh.blend.end(), {at_a, at_b, at_b, at_a, at_b, at_a});
    }
  }
}

float skirt_depth_m(const TinMesh& mesh, double neighbour_error_m) {
  // Both surfaces stay within their errors of the ground; a little more covers rounding and pixel gaps.
  return static_cast<float>(1.25 * (mesh.max_error_m + neighbour_error_m) + 0.01);
}

}  // namespace lodestone
