#include "kernels/fractal/fractal_task.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>

#include "kernels/fractal/fractal_windows.h"
#include "kernels/shared/ls_fractal.h"

namespace lodestone {
namespace {

PostWindow halved(const PostWindow& w, std::int64_t halo) {
  return {(w.i0 >> 1) - halo, (w.j0 >> 1) - halo, ceil_shift(w.i1, 1) + halo, ceil_shift(w.j1, 1) + halo};
}

PostWindow tile_window(const FractalTask& task) {
  return {task.x0, task.y0, task.x0 + task.posts - 1, task.y0 + task.posts - 1};
}

PostWindow clipped(PostWindow w, const PostWindow& limits) {
  w.i0 = std::clamp(w.i0, limits.i0, limits.i1);
  w.j0 = std::clamp(w.j0, limits.j0, limits.j1);
  w.i1 = std::clamp(w.i1, w.i0, limits.i1);
  w.j1 = std::clamp(w.j1, w.j0, limits.j1);
  return w;
}

// Posts around coarse() within which displacements can matter.
std::int64_t reach_cells(const FractalTask& task) { return reads_heights(task) ? 6 : 4; }

Error broken(const std::string& what) { return {ErrorCode::kInvalidArgument, "fractal task: " + what}; }

bool holds(const PostWindow& outer, const PostWindow& inner) {
  return outer.contains(inner.i0, inner.j0) && outer.contains(inner.i1, inner.j1);
}

Result<void> check_mask(const FractalTask& task, const std::optional<MaskCrop>& mask,
                        const std::string& name) {
  if (!mask) return {};
  if (mask->level < -16 || mask->level > 16)
    return broken(name + " level must be -16..16, found " + std::to_string(mask->level));
  const PostWindow have{mask->i0, mask->j0, mask->i0 + mask->width - 1, mask->j0 + mask->height - 1};
  if (have.is_empty() || mask->pixels.size() != static_cast<std::size_t>(have.width() * have.height()))
    return broken(name + " must hold width * height pixels, found " + std::to_string(mask->pixels.size()));
  if (!holds(have, mask_window(task, mask->level))) return broken(name + " does not hold mask_window()");
  return {};
}

Result<void> check_rules(const FractalParameters& p) {
  if (p.altitude) {
    const AltitudeRule& a = *p.altitude;
    if (!(a.z1_m > a.z0_m) || !std::isfinite(a.z0_m) || !std::isfinite(a.z1_m))
      return broken("altitude must have finite z0 < z1, found " + std::to_string(a.z0_m) + " and " +
                    std::to_string(a.z1_m));
    if (!std::isfinite(a.lo) || !std::isfinite(a.hi)) return broken("altitude factors must be finite");
  }
  if (p.cap_m && !(*p.cap_m >= 0))
    return broken("cap must be 0 m or more, found " + std::to_string(*p.cap_m));
  if (p.water_m && !std::isfinite(*p.water_m)) return broken("water level must be finite");
  if (p.channel < 0 || p.channel > 255)
    return broken("channel must be 0..255, found " + std::to_string(p.channel));
  return {};
}

}  // namespace

bool reads_heights(const FractalTask& task) {
  return task.method == FractalMethod::kFractalWavelet &&
         (task.parameters.altitude || task.parameters.erosion);
}

std::vector<FractalStep> fractal_steps(const FractalTask& task) {
  std::vector<FractalStep> steps(static_cast<std::size_t>(task.depth));
  PostWindow want = tile_window(task);
  if (task.method != FractalMethod::kSquareSquare) {
    const std::int64_t halo = task.method == FractalMethod::kDiamondSquare ? 1 : 2;
    for (std::size_t s = steps.size(); s-- > 0;) {
      want = halved(want, halo);
      steps[s] = {want, want};
    }
    return steps;
  }
  want.i0 -= 1;  // cells around the tile's posts
  want.j0 -= 1;
  for (std::size_t s = steps.size(); s-- > 0;) {
    const PostWindow items{want.i0 >> 1, want.j0 >> 1, want.i1 >> 1, want.j1 >> 1};
    if (s > 0)
      want = {(want.i0 - 1) >> 1, (want.j0 - 1) >> 1, (want.i1 + 1) >> 1, (want.j1 + 1) >> 1};
    else
      want = {items.i0, items.j0, items.i1 + 1, items.j1 + 1};
    steps[s] = {items, want};
  }
  return steps;
}

PostWindow coarse_window(const FractalTask& task) {
  PostWindow w = tile_window(task);
  if (task.method == FractalMethod::kFractalWavelet && !reads_heights(task))
    w = {floor_shift(w.i0, task.depth), floor_shift(w.j0, task.depth), ceil_shift(w.i1, task.depth),
         ceil_shift(w.j1, task.depth)};
  else
    w = fractal_steps(task).front().needed;
  return clipped(w, task.world);
}

BandPlace band_place(const FractalTask& task, const FractalStep& step, int s, int band) {
  if (band == 0) {
    return {2 * (2 * step.items.i0 - (task.world.i0 << (s + 1))) + 1,
            2 * (2 * step.items.j0 - (task.world.j0 << (s + 1))) + 1, s + 2};
  }
  return {2 * (step.items.i0 - (task.world.i0 << s)) + (band & 1),
          2 * (step.items.j0 - (task.world.j0 << s)) + (band >> 1), s + 1};
}

std::int64_t node_coordinate(std::int64_t x0, int shift, int node_log2, NodeLookup lookup) {
  return lookup == NodeLookup::kSmooth ? x0 - (std::int64_t{1} << (shift + node_log2 - 1)) : x0;
}

NodeRange node_range(std::int64_t x0, int count, int shift, int node_log2, NodeLookup lookup,
                     std::int64_t nodes) {
  const std::int64_t t = node_coordinate(x0, shift, node_log2, lookup);
  const int all = static_cast<int>(nodes);
  const int smooth = lookup == NodeLookup::kSmooth;
  return {ls_nodes_at(t, shift + node_log2, 0.0F, smooth, all, 0, all).n0,
          ls_nodes_at(t + 2 * std::int64_t{count - 1}, shift + node_log2, 0.0F, smooth, all, 0, all).n1};
}

PostWindow node_window(const FractalTask& task, int node_log2) {
  const PostWindow all = layer_nodes(task.world, node_log2);
  PostWindow nodes{all.i1, all.j1, 0, 0};
  const std::vector<FractalStep> steps = fractal_steps(task);
  const bool is_square = task.method == FractalMethod::kSquareSquare;
  for (int s = 0; s < task.depth; ++s) {
    const FractalStep& step = steps[static_cast<std::size_t>(s)];
    const int per_item = is_square ? 2 : 1;
    for (int band = is_square ? 0 : 1; band <= (is_square ? 0 : 3); ++band) {
      const BandPlace place = band_place(task, step, s, band);
      const NodeRange x = node_range(place.x0, static_cast<int>(step.items.width()) * per_item, place.shift,
                                     node_log2, task.parameters.lookup, all.width());
      const NodeRange y = node_range(place.y0, static_cast<int>(step.items.height()) * per_item, place.shift,
                                     node_log2, task.parameters.lookup, all.height());
      nodes = {std::min(nodes.i0, x.first), std::min(nodes.j0, y.first), std::max(nodes.i1, x.last),
               std::max(nodes.j1, y.last)};
    }
  }
  return nodes;
}

PostWindow mask_window(const FractalTask& task, int mask_level) {
  const std::int64_t reach = reach_cells(task) + 2;  // and the support of a displacement there
  const auto low = [&](std::int64_t x, std::int64_t origin) {
    return floor_shift(x, task.depth) - origin - reach;
  };
  const auto high = [&](std::int64_t x, std::int64_t origin) {
    return ceil_shift(x, task.depth) - origin + reach;
  };
  const auto pixel_low = [&](std::int64_t c) {
    return mask_level >= 0 ? c << mask_level : floor_shift(c, -mask_level);
  };
  const auto pixel_high = [&](std::int64_t c) {
    return mask_level >= 0 ? c << mask_level : ceil_shift(c, -mask_level);
  };
  const PostWindow tile = tile_window(task);
  return {pixel_low(low(tile.i0, task.world.i0)) - 1, pixel_low(low(tile.j0, task.world.j0)) - 1,
          pixel_high(high(tile.i1, task.world.i0)), pixel_high(high(tile.j1, task.world.j0))};
}

Result<void> check(const FractalTask& task) {
  if (task.world.width() < 2 || task.world.height() < 2)
    return broken("the world must have at least 2 x 2 posts");
  if (task.depth < 1 || task.depth > kMaxDepth)
    return broken("depth must be 1.." + std::to_string(kMaxDepth) + ", found " + std::to_string(task.depth));
  if (task.posts < 1 || task.posts > 2049)
    return broken("posts must be 1..2049, found " + std::to_string(task.posts));
  if (task.base_level < 0 || task.base_level + task.depth > 255)
    return broken("levels must be 0..255, found base " + std::to_string(task.base_level) + " and depth " +
                  std::to_string(task.depth));
  constexpr std::int64_t kFar = std::int64_t{1} << 40;
  for (const std::int64_t v : {task.world.i0, task.world.j0, task.world.i1, task.world.j1})
    if (v < -kFar || v > kFar)
      return broken("world indices must lie within 2^40, found " + std::to_string(v));
  for (const std::int64_t v : {task.x0 >> task.depth, task.y0 >> task.depth})
    if (v < -kFar || v > kFar)
      return broken("tile indices must lie within 2^40 data posts, found " + std::to_string(v));
  if (Result<void> rules = check_rules(task.parameters); !rules) return rules;

  const PostWindow coarse = coarse_window(task);
  if (task.coarse_m.size() != static_cast<std::size_t>(coarse.width() * coarse.height()))
    return broken("coarse_m must hold coarse_window(), " + std::to_string(coarse.width() * coarse.height()) +
                  " heights, found " + std::to_string(task.coarse_m.size()));
  const NodeCrop& n = task.nodes;
  if (n.node_log2 < 2 || n.node_log2 > kMaxNodeLog2)
    return broken("node_log2 must be 2.." + std::to_string(kMaxNodeLog2) + ", found " +
                  std::to_string(n.node_log2));
  const PostWindow all = layer_nodes(task.world, n.node_log2);
  if (n.layer_width != all.width() || n.layer_height != all.height())
    return broken("the layer has " + std::to_string(all.width()) + " x " + std::to_string(all.height()) +
                  " nodes, the crop says " + std::to_string(n.layer_width) + " x " +
                  std::to_string(n.layer_height));
  const PostWindow have{n.i0, n.j0, n.i0 + n.width - 1, n.j0 + n.height - 1};
  if (have.is_empty() || n.nodes.size() != static_cast<std::size_t>(have.width() * have.height()) ||
      !holds(have, node_window(task, n.node_log2)))
    return broken("nodes does not hold node_window()");
  if (Result<void> mask = check_mask(task, task.mask, "mask"); !mask) return mask;
  return check_mask(task, task.void_mask, "void_mask");
}

}  // namespace lodestone
