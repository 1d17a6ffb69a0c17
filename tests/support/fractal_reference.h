#pragma once
// The fractal methods written down a second time, slowly, over the whole world, straight from the
// specification's formulas.

#include <algorithm>
#include <cmath>
#include <map>
#include <random>
#include <vector>

#include "kernels/fractal/fractal_task.h"
#include "kernels/shared/ls_random.h"

namespace lodestone::testing {

struct RefGrid {
  std::int64_t i0 = 0, j0 = 0, i1 = 0, j1 = 0;
  std::vector<float> v;
  RefGrid(std::int64_t a, std::int64_t b, std::int64_t c, std::int64_t d) : i0(a), j0(b), i1(c), j1(d) {
    v.assign(static_cast<std::size_t>((c - a + 1) * (d - b + 1)), 0.0F);
  }
  bool has(std::int64_t i, std::int64_t j) const { return i >= i0 && i <= i1 && j >= j0 && j <= j1; }
  float& at(std::int64_t i, std::int64_t j) {
    return v[static_cast<std::size_t>((j - j0) * (i1 - i0 + 1) + i - i0)];
  }
  float clamped(std::int64_t i, std::int64_t j) { return at(std::clamp(i, i0, i1), std::clamp(j, j0, j1)); }
  float or_zero(std::int64_t i, std::int64_t j) { return has(i, j) ? at(i, j) : 0.0F; }
};

// A world with its nodes; tasks are cut from it.
struct FractalWorld {
  PostWindow world;
  std::vector<float> heights;
  NodeCrop nodes;  // all

  float at(std::int64_t i, std::int64_t j) const {
    return heights[static_cast<std::size_t>((j - world.j0) * world.width() + i - world.i0)];
  }
  // Fills coarse_m and nodes; with only_needed, everything else is left out.
  void fill(FractalTask& task) const {
    task.world = world;
    const PostWindow c = coarse_window(task);
    task.coarse_m.clear();
    for (std::int64_t j = c.j0; j <= c.j1; ++j)
      for (std::int64_t i = c.i0; i <= c.i1; ++i) task.coarse_m.push_back(at(i, j));
    const PostWindow n = node_window(task, nodes.node_log2);
    task.nodes = {nodes.node_log2,
                  n.i0,
                  n.j0,
                  static_cast<int>(n.width()),
                  static_cast<int>(n.height()),
                  nodes.layer_width,
                  nodes.layer_height,
                  {}};
    for (std::int64_t j = n.j0; j <= n.j1; ++j)
      for (std::int64_t i = n.i0; i <= n.i1; ++i)
        task.nodes.nodes.push_back(nodes.nodes[static_cast<std::size_t>(j * nodes.layer_width + i)]);
  }
};

inline FractalWorld random_fractal_world(std::uint32_t seed, std::int64_t width, std::int64_t height,
                                         int node_log2, std::int64_t i0 = 0, std::int64_t j0 = 0) {
  std::mt19937 rng(seed);
  const auto unit = [&] { return static_cast<float>(rng() >> 8) * 0x1p-24F; };
  FractalWorld w;
  w.world = {i0, j0, i0 + width - 1, j0 + height - 1};
  for (std::int64_t n = 0; n < width * height; ++n) w.heights.push_back(500.0F + 200.0F * unit());
  const PostWindow all = layer_nodes(w.world, node_log2);
  w.nodes = {node_log2,    0, 0, static_cast<int>(all.width()), static_cast<int>(all.height()), all.width(),
             all.height(), {}};
  for (std::int64_t n = 0; n < all.width() * all.height(); ++n)
    w.nodes.nodes.push_back({rng() % 8 == 0 ? 0.0F : 20.0F * unit(), 0.1F + 1.2F * unit()});
  return w;
}

class FractalReference {
 public:
  FractalReference(const FractalWorld& world, const FractalTask& task) : world_(world), task_(task) {}

  // All posts of the level `depth` below the data.
  RefGrid run() {
    if (task_.method == FractalMethod::kSquareSquare) return square();
    RefGrid h = data();
    for (int s = 0; s < task_.depth; ++s)
      h = task_.method == FractalMethod::kDiamondSquare ? diamond(h, s) : wavelet(h, s);
    return h;
  }

 private:
  RefGrid data() const {
    RefGrid h(world_.world.i0, world_.world.j0, world_.world.i1, world_.world.j1);
    h.v = world_.heights;
    return h;
  }

  // Position in data cells from the world's corner.
  float deviation(double x, double y, int n, NodeKind kind) const {
    const double size = static_cast<double>(1 << world_.nodes.node_log2);
    const auto axis = [&](double p, std::int64_t count, std::int64_t& a, std::int64_t& b, float& f) {
      if (task_.parameters.lookup == NodeLookup::kSmooth) {
        const double u = std::clamp(p / size - 0.5, 0.0, static_cast<double>(count - 1));
        a = std::max<std::int64_t>(
            0, std::min<std::int64_t>(static_cast<std::int64_t>(std::floor(u)), count - 2));
        b = std::min<std::int64_t>(a + 1, count - 1);
        f = static_cast<float>(u - static_cast<double>(a));
      } else {
        const double u = p / size;
        b = std::min<std::int64_t>(static_cast<std::int64_t>(std::floor(u)), count - 1);
        a = std::min<std::int64_t>(u == std::floor(u) && u > 0 ? static_cast<std::int64_t>(u) - 1 : b,
                                   count - 1);
        f = u == std::floor(u) && u > 0 ? 0.5F : 0.0F;
      }
    };
    std::int64_t a = 0, b = 0, c = 0, d = 0;
    float fx = 0, fy = 0;
    axis(x, world_.nodes.layer_width, a, b, fx);
    axis(y, world_.nodes.layer_height, c, d, fy);
    const auto value = [&](std::int64_t i, std::int64_t j) {
      return node_deviation(world_.nodes.nodes[static_cast<std::size_t>(j * world_.nodes.layer_width + i)], n,
                            kind);
    };
    const float top = value(a, c) + fx * (value(b, c) - value(a, c));
    const float bottom = value(a, d) + fx * (value(b, d) - value(a, d));
    return top + fy * (bottom - top);
  }

  float noise(std::int64_t i, std::int64_t j, int level, int band, int algo) const {
    return ls_gaussian(static_cast<ls_uint>(i), static_cast<ls_uint>(j),
                       ls_stream(static_cast<ls_uint>(level), static_cast<ls_uint>(band),
                                 static_cast<ls_uint>(algo), static_cast<ls_uint>(task_.parameters.channel)),
                       static_cast<ls_uint>(task_.seed), static_cast<ls_uint>(task_.seed >> 32));
  }

  static float q(float a, float b) { return (a + (a + b) * 0.5F) * 0.5F; }

  RefGrid square() {
    RefGrid from = data();
    const PostWindow& w = world_.world;
    for (int n = 1; n <= task_.depth; ++n) {
      RefGrid to(w.i0 << n, w.j0 << n, (w.i1 << n) - 1, (w.j1 << n) - 1);
      for (std::int64_t r = to.j0; r <= to.j1; ++r) {
        for (std::int64_t p = to.i0; p <= to.i1; ++p) {
          const auto pair = [&](std::int64_t k, std::int64_t& own, std::int64_t& other) {
            own = n == 1 ? (k + 1) >> 1 : k >> 1;
            const bool odd = k & 1;
            other = n == 1 ? (odd ? own - 1 : own + 1) : (odd ? own + 1 : own - 1);
          };
          std::int64_t ox = 0, px = 0, oy = 0, py = 0;
          pair(p, ox, px);
          pair(r, oy, py);
          const float own_row = q(from.clamped(ox, oy), from.clamped(px, oy));
          const float other_row = q(from.clamped(ox, py), from.clamped(px, py));
          const double step = std::ldexp(1.0, -(n + 1));
          const double x = static_cast<double>(2 * (p - (w.i0 << n)) + 1) * step,
                       y = static_cast<double>(2 * (r - (w.j0 << n)) + 1) * step;
          to.at(p, r) = q(own_row, other_row) +
                        deviation(x, y, n, NodeKind::kSquare) * noise(p, r, task_.base_level + n, 0, 2);
        }
      }
      from = to;
    }
    RefGrid out(w.i0 << task_.depth, w.j0 << task_.depth, w.i1 << task_.depth, w.j1 << task_.depth);
    for (std::int64_t j = out.j0; j <= out.j1; ++j)
      for (std::int64_t i = out.i0; i <= out.i1; ++i)
        out.at(i, j) = ((from.clamped(i - 1, j - 1) + from.clamped(i, j - 1)) * 0.5F +
                        (from.clamped(i - 1, j) + from.clamped(i, j)) * 0.5F) *
                       0.5F;
    return out;
  }

  // Deviation of the new point (X, Y) of level s + 1.
  float delta(std::int64_t x, std::int64_t y, int s, int algo) const {
    const int band = static_cast<int>((x & 1) + 2 * (y & 1));
    const PostWindow& w = world_.world;
    const double step = std::ldexp(1.0, -(s + 1));
    const NodeKind kind = algo == 3 ? (band == 3 ? NodeKind::kDiamondCentre : NodeKind::kDiamondEdge)
                                    : (band == 3 ? NodeKind::kWaveletCentre : NodeKind::kWaveletEdge);
    return deviation(static_cast<double>(x - (w.i0 << (s + 1))) * step,
                     static_cast<double>(y - (w.j0 << (s + 1))) * step, s + 1, kind) *
           noise(x >> 1, y >> 1, task_.base_level + s, band, algo);
  }

  RefGrid diamond(RefGrid& h, int s) {
    RefGrid out(2 * h.i0, 2 * h.j0, 2 * h.i1, 2 * h.j1);
    for (std::int64_t y = out.j0; y <= out.j1; ++y)
      for (std::int64_t x = out.i0; x <= out.i1; ++x) {
        const std::int64_t i = x >> 1, j = y >> 1;
        if (!(x & 1) && !(y & 1)) out.at(x, y) = h.at(i, j);
        if ((x & 1) && (y & 1))
          out.at(x, y) = ((h.at(i, j) + h.at(i + 1, j)) + (h.at(i, j + 1) + h.at(i + 1, j + 1))) * 0.25F +
                         delta(x, y, s, 3);
      }
    for (std::int64_t y = out.j0; y <= out.j1; ++y)
      for (std::int64_t x = out.i0; x <= out.i1; ++x) {
        if (((x ^ y) & 1) == 0) continue;
        const std::int64_t dx = x & 1, dy = y & 1;
        const bool has0 = out.has(x - dy, y - dx), has1 = out.has(x + dy, y + dx);
        const float c0 = has0 ? out.at(x - dy, y - dx) : out.at(x + dy, y + dx);
        const float c1 = has1 ? out.at(x + dy, y + dx) : c0;
        out.at(x, y) =
            ((out.at(x - dx, y - dy) + out.at(x + dx, y + dy)) + (c0 + c1)) * 0.25F + delta(x, y, s, 3);
      }
    return out;
  }

  float rule(float dh, float base, float lowest) const {
    const FractalParameters& p = task_.parameters;
    if (p.altitude) {
      const float t =
          std::clamp((base - p.altitude->z0_m) * (1.0F / (p.altitude->z1_m - p.altitude->z0_m)), 0.0F, 1.0F);
      dh = dh * (p.altitude->lo + (p.altitude->hi - p.altitude->lo) * t);
    }
    if (p.cap_m) dh = std::clamp(dh, -*p.cap_m, *p.cap_m);
    if (p.erosion && (!p.water_m || base > *p.water_m)) dh = std::max(dh, lowest - base);
    return dh;
  }

  // Area under the unit hats, by counting cells of the world.
  float theta(const RefGrid& h, std::int64_t x, std::int64_t y) const {
    const auto cells = [&](std::int64_t i, std::int64_t j) {
      return ((i > h.i0) + (i < h.i1)) * ((j > h.j0) + (j < h.j1));
    };
    const std::int64_t i = x >> 1, j = y >> 1;
    int top = 0, bottom = 0;
    if ((x & 1) && (y & 1)) {
      top = 2;
      for (int b = 0; b < 2; ++b)
        for (int a = 0; a < 2; ++a) bottom += cells(i + a, j + b) * (((i + a + j + b) & 1) ? 1 : 2);
    } else {
      const int adjacent = (x & 1) ? (j > h.j0) + (j < h.j1) : (i > h.i0) + (i < h.i1);
      top = adjacent;
      bottom = 2 * (cells(i, j) + cells(i + (x & 1), j + (y & 1))) + 4 * adjacent;
    }
    return task_.parameters.volume == VolumeRule::kPublished
               ? static_cast<float>(3 * top) / static_cast<float>(4 * bottom)
               : static_cast<float>(top) / static_cast<float>(bottom);
  }

  RefGrid wavelet(RefGrid& h, int s) {
    RefGrid out(2 * h.i0, 2 * h.j0, 2 * h.i1, 2 * h.j1), dh = out, w = out;
    // half-step 1
    for (std::int64_t y = out.j0 + 1; y <= out.j1; y += 2)
      for (std::int64_t x = out.i0 + 1; x <= out.i1; x += 2) {
        const std::int64_t i = x >> 1, j = y >> 1;
        const float nw = h.at(i, j), ne = h.at(i + 1, j), sw = h.at(i, j + 1), se = h.at(i + 1, j + 1);
        const float base = ((i + j) & 1) ? (ne + sw) * 0.5F : (nw + se) * 0.5F;
        dh.at(x, y) = rule(delta(x, y, s, 4), base, std::min({nw, ne, sw, se}));
        w.at(x, y) = theta(h, x, y) * dh.at(x, y);
      }
    for (std::int64_t y = out.j0; y <= out.j1; y += 2)
      for (std::int64_t x = out.i0; x <= out.i1; x += 2)
        out.at(x, y) = h.at(x >> 1, y >> 1) - ((w.or_zero(x - 1, y - 1) + w.or_zero(x + 1, y - 1)) +
                                               (w.or_zero(x - 1, y + 1) + w.or_zero(x + 1, y + 1)));
    for (std::int64_t y = out.j0 + 1; y <= out.j1; y += 2)
      for (std::int64_t x = out.i0 + 1; x <= out.i1; x += 2) {
        const bool odd = ((x >> 1) + (y >> 1)) & 1;
        const float base = odd ? (out.at(x + 1, y - 1) + out.at(x - 1, y + 1)) * 0.5F
                               : (out.at(x - 1, y - 1) + out.at(x + 1, y + 1)) * 0.5F;
        out.at(x, y) = base + dh.at(x, y);
      }
    // half-step 2
    RefGrid before = out;
    for (std::int64_t y = out.j0; y <= out.j1; ++y)
      for (std::int64_t x = out.i0; x <= out.i1; ++x) {
        if (((x ^ y) & 1) == 0) continue;
        const std::int64_t dx = x & 1, dy = y & 1;
        const float a = before.at(x - dx, y - dy), b = before.at(x + dx, y + dy);
        float lowest = std::min(a, b);
        if (out.has(x - dy, y - dx)) lowest = std::min(lowest, before.at(x - dy, y - dx));
        if (out.has(x + dy, y + dx)) lowest = std::min(lowest, before.at(x + dy, y + dx));
        dh.at(x, y) = rule(delta(x, y, s, 4), (a + b) * 0.5F, lowest);
        w.at(x, y) = theta(h, x, y) * dh.at(x, y);
      }
    for (std::int64_t y = out.j0; y <= out.j1; ++y)
      for (std::int64_t x = out.i0; x <= out.i1; ++x) {
        if ((x ^ y) & 1) continue;
        const float we = w.or_zero(x - 1, y) + w.or_zero(x + 1, y),
                    ns = w.or_zero(x, y - 1) + w.or_zero(x, y + 1);
        out.at(x, y) = before.at(x, y) - ((x & 1) ? ns + we : we + ns);
      }
    for (std::int64_t y = out.j0; y <= out.j1; ++y)
      for (std::int64_t x = out.i0; x <= out.i1; ++x) {
        if (((x ^ y) & 1) == 0) continue;
        const std::int64_t dx = x & 1, dy = y & 1;
        out.at(x, y) = (out.at(x - dx, y - dy) + out.at(x + dx, y + dy)) * 0.5F + dh.at(x, y);
      }
    return out;
  }

  const FractalWorld& world_;
  const FractalTask& task_;
};

}  // namespace lodestone::testing
