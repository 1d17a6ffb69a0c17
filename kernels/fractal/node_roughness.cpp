#include "kernels/fractal/node_roughness.h"

#include <algorithm>
#include <array>
#include <cassert>
#include <cmath>
#include <span>

#include "kernels/synthesis/roughness.h"

namespace lodestone {
namespace {

constexpr int kScales = 3;  // tau = 1, 2, 4
constexpr double kFlat_m2 = 0x1p-40;
constexpr std::int64_t kMinResiduals = 16;

struct Residuals {
  double sum_m2 = 0;
  std::int64_t count = 0;
};

// Second differences along both axes at every post of the closed node.
Residuals residuals(const HeightGrid& grid, const PostWindow& world, const PostWindow& node,
                    std::int64_t tau) {
  Residuals r;
  const auto add = [&](std::int64_t i, std::int64_t j, std::int64_t di, std::int64_t dj) {
    if (!world.contains(i - di, j - dj) || !world.contains(i + di, j + dj)) return;
    if (grid.void_at(i, j) || grid.void_at(i - di, j - dj) || grid.void_at(i + di, j + dj)) return;
    const double mean =
        (static_cast<double>(grid.at(i - di, j - dj)) + static_cast<double>(grid.at(i + di, j + dj))) * 0.5;
    const double d = static_cast<double>(grid.at(i, j)) - mean;
    r.sum_m2 += d * d;
    ++r.count;
  };
  for (std::int64_t j = node.j0; j <= node.j1; ++j) {
    for (std::int64_t i = node.i0; i <= node.i1; ++i) {
      add(i, j, tau, 0);
      add(i, j, 0, tau);
    }
  }
  return r;
}

NodeRoughness fit(const std::array<Residuals, kScales>& scales) {
  double sw = 0, sx = 0, sy = 0, sxx = 0, sxy = 0, weight = 1;
  int used = 0;
  for (int l = 0; l < kScales; ++l, weight *= 0.25) {
    const Residuals& r = scales[static_cast<std::size_t>(l)];
    const double mean_m2 = r.count > 0 ? r.sum_m2 / static_cast<double>(r.count) : 0;
    const bool enough = r.count >= kMinResiduals;
    if (l == 0 && enough && mean_m2 <= kFlat_m2) return {0.0F, 0.8F};
    if (!enough || mean_m2 <= kFlat_m2) continue;
    const double x = l, y = det_log2(mean_m2);
    sw += weight;
    sx += weight * x;
    sy += weight * y;
    sxx += weight * x * x;
    sxy += weight * x * y;
    ++used;
  }
  if (used == 0) return {0.0F, 0.8F};
  double h = 0.8;
  if (used > 1) h = std::clamp((sw * sxy - sx * sy) / (sw * sxx - sx * sx) * 0.5, 0.05, 1.9);
  const double log2_variance = sy / sw - 2 * h * (sx / sw);
  return {static_cast<float>(det_exp2(log2_variance * 0.5)), static_cast<float>(h)};
}

struct Neighbour {
  double weight, x, y;  // in units of half the parent spacing
};

std::array<Neighbour, 4> predictor(NodeKind kind) {
  switch (kind) {
    case NodeKind::kDiamondCentre:
      return {{{0.25, -1, -1}, {0.25, 1, -1}, {0.25, -1, 1}, {0.25, 1, 1}}};
    case NodeKind::kDiamondEdge:
      return {{{0.25, -1, 0}, {0.25, 1, 0}, {0.25, 0, -1}, {0.25, 0, 1}}};
    default:
      return {{{0.5625, -0.5, -0.5}, {0.1875, 1.5, -0.5}, {0.1875, -0.5, 1.5}, {0.0625, 1.5, 1.5}}};
  }
}

// distance^2H
double variogram(double distance2, double h) { return distance2 > 0 ? det_exp2(h * det_log2(distance2)) : 0; }

}  // namespace

PostWindow layer_nodes(const PostWindow& world, int node_log2) {
  const auto count = [&](std::int64_t posts) {
    return std::max<std::int64_t>(1, ceil_shift(posts - 1, node_log2));
  };
  return {0, 0, count(world.width()) - 1, count(world.height()) - 1};
}

PostWindow node_heights_window(const PostWindow& nodes, const PostWindow& world, int node_log2) {
  return {std::max(world.i0, world.i0 + (nodes.i0 << node_log2) - 4),
          std::max(world.j0, world.j0 + (nodes.j0 << node_log2) - 4),
          std::min(world.i1, world.i0 + ((nodes.i1 + 1) << node_log2) + 4),
          std::min(world.j1, world.j0 + ((nodes.j1 + 1) << node_log2) + 4)};
}

NodeCrop estimate_nodes(const HeightGrid& heights, const PostWindow& world, const PostWindow& nodes,
                        int node_log2) {
  const PostWindow all = layer_nodes(world, node_log2);
  NodeCrop crop{
      node_log2,   nodes.i0,     nodes.j0, static_cast<int>(nodes.width()), static_cast<int>(nodes.height()),
      all.width(), all.height(), {}};
  crop.nodes.reserve(static_cast<std::size_t>(nodes.width() * nodes.height()));
  for (std::int64_t b = nodes.j0; b <= nodes.j1; ++b) {
    for (std::int64_t a = nodes.i0; a <= nodes.i1; ++a) {
      const PostWindow node{world.i0 + (a << node_log2), world.j0 + (b << node_log2),
                            std::min(world.i1, world.i0 + ((a + 1) << node_log2)),
                            std::min(world.j1, world.j0 + ((b + 1) << node_log2))};
      std::array<Residuals, kScales> scales;
      for (int l = 0; l < kScales; ++l)
        scales[static_cast<std::size_t>(l)] = residuals(heights, world, node, 1 << l);
      crop.nodes.push_back(fit(scales));
    }
  }
  return crop;
}

double predictor_ratio(double h, NodeKind kind) {
  if (kind == NodeKind::kWaveletCentre || kind == NodeKind::kWaveletEdge) return 1;
  h = std::min(h, 0.95);
  const std::array<Neighbour, 4> points = predictor(kind);
  double to_point = 0, among = 0;
  for (std::size_t a = 0; a < points.size(); ++a) {
    to_point += points[a].weight * variogram(points[a].x * points[a].x + points[a].y * points[a].y, h);
    for (std::size_t b = 0; b < a; ++b) {
      const double dx = points[a].x - points[b].x, dy = points[a].y - points[b].y;
      among += points[a].weight * points[b].weight * variogram(dx * dx + dy * dy, h);
    }
  }
  const double segment = 1 - det_exp2(2 * h - 2);
  return std::sqrt((to_point - among) / segment);
}

float node_deviation(const NodeRoughness& node, int n, NodeKind kind) {
  assert(n >= 1 && "iterations count from 1");
  if (node.sigma_m <= 0) return 0;
  const double h = static_cast<double>(node.h);
  const double steps = kind == NodeKind::kWaveletCentre ? n - 0.5 : n;
  return static_cast<float>(static_cast<double>(node.sigma_m) * det_exp2(-steps * h) *
                            predictor_ratio(h, kind));
}

}  // namespace lodestone
