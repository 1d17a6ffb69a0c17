#include "kernels/fractal/level_of_detail.h"

#include <algorithm>
#include <cmath>

namespace lodestone {

double projected_px(double length_m, double distance_m, const ProjectionRule& rule) {
  return length_m * rule.width_px / (2 * distance_m * std::tan(rule.fov_rad / 2));
}

double distance_threshold_m(double length_m, const ProjectionRule& rule) {
  return length_m * rule.width_px / (2 * rule.tolerance_px * std::tan(rule.fov_rad / 2));
}

int fractal_iterations(double spacing_m, double distance_m, int max_iterations, const ProjectionRule& rule) {
  if (!(distance_m > 0)) return max_iterations;
  double threshold_m = distance_threshold_m(spacing_m, rule);
  int n = 0;
  while (n < max_iterations && threshold_m > distance_m) {
    threshold_m *= 0.5;
    ++n;
  }
  return n;
}

std::vector<float> shared_edge(std::span<const float> coarse_m, int levels) {
  std::vector<float> edge(coarse_m.begin(), coarse_m.end());
  for (int l = 0; l < levels && edge.size() > 1; ++l) {
    std::vector<float> finer(2 * edge.size() - 1);
    for (std::size_t n = 0; n < edge.size(); ++n) finer[2 * n] = edge[n];
    for (std::size_t n = 1; n < finer.size(); n += 2) finer[n] = (finer[n - 1] + finer[n + 1]) * 0.5F;
    edge = std::move(finer);
  }
  return edge;
}

Diagonal shorter_diagonal(float nw, float ne, float sw, float se) {
  return std::abs(nw - se) <= std::abs(ne - sw) ? Diagonal::kNorthWestSouthEast
                                                : Diagonal::kNorthEastSouthWest;
}

Diagonal lowest_diagonal(float nw, float ne, float sw, float se) {
  if (std::max(nw, se) < std::min(ne, sw)) return Diagonal::kNorthWestSouthEast;
  if (std::max(ne, sw) < std::min(nw, se)) return Diagonal::kNorthEastSouthWest;
  return shorter_diagonal(nw, ne, sw, se);
}

Vector3 triangle_normal(const Vector3& a, const Vector3& b, const Vector3& c) {
  const Vector3 u{b[0] - a[0], b[1] - a[1], b[2] - a[2]}, v{c[0] - b[0], c[1] - b[1], c[2] - b[2]};
  return {u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]};
}

bool is_facing(const Vector3& a, const Vector3& b, const Vector3& c, const Vector3& eye) {
  const Vector3 n = triangle_normal(a, b, c);
  return n[0] * (eye[0] - a[0]) + n[1] * (eye[1] - a[1]) + n[2] * (eye[2] - a[2]) > 0;
}

}  // namespace lodestone
