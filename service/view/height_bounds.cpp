#include "service/view/height_bounds.h"

#include <algorithm>
#include <cmath>

#include "kernels/fractal/node_roughness.h"

namespace lodestone {
namespace {

PostWindow common(const PostWindow& a, const PostWindow& b) {
  return {std::max(a.i0, b.i0), std::max(a.j0, b.j0), std::min(a.i1, b.i1), std::min(a.j1, b.j1)};
}

// `scale`: base cells per cell of the grid.
GroundRange range_of(const HeightGrid& grid, float scale) {
  const auto width = static_cast<std::size_t>(grid.window.width());
  const auto height = static_cast<std::size_t>(grid.window.height());
  const std::vector<float>& h = grid.heights_m;
  GroundRange r{h[0], h[0], 0, 0, 0, 0};
  if (width > 1) r.east_min = r.east_max = h[1] - h[0];
  if (height > 1) r.south_min = r.south_max = h[width] - h[0];
  for (std::size_t row = 0; row < height; ++row) {
    const float* line = &h[row * width];
    for (std::size_t n = 0; n < width; ++n) {
      r.low_m = std::min(r.low_m, line[n]);
      r.high_m = std::max(r.high_m, line[n]);
    }
    for (std::size_t n = 1; n < width; ++n) {
      const float d = line[n] - line[n - 1];
      r.east_min = std::min(r.east_min, d);
      r.east_max = std::max(r.east_max, d);
    }
    if (row == 0) continue;
    for (std::size_t n = 0; n < width; ++n) {
      const float d = line[n] - (line - width)[n];
      r.south_min = std::min(r.south_min, d);
      r.south_max = std::max(r.south_max, d);
    }
  }
  for (float* d : {&r.east_min, &r.east_max, &r.south_min, &r.south_max}) *d /= scale;
  return r;
}

bool keeps_base_posts(const Recipe& recipe) {
  return recipe.method == Method::kLinear || recipe.method == Method::kDiamondSquare ||
         (recipe.method <= Method::kLsa && recipe.basis == WaveletBasis::kCdf22);
}

}  // namespace

GroundRange joined(const GroundRange& a, const GroundRange& b) {
  return {std::min(a.low_m, b.low_m),       std::max(a.high_m, b.high_m),       std::min(a.east_min, b.east_min),
          std::max(a.east_max, b.east_max), std::min(a.south_min, b.south_min), std::max(a.south_max, b.south_max)};
}

Result<void> HeightBounds::read_all() const {
  const LayerInfo& info = layer_->info();
  std::map<TileId, GroundRange> all;
  for (int z = info.base_level; z >= 0; --z) {
    const PostWindow tiles = info.tiles_at(z);
    const PostWindow world = info.world_at(z);
    for (std::int64_t y = tiles.j0; y <= tiles.j1; ++y) {
      for (std::int64_t x = tiles.i0; x <= tiles.i1; ++x) {
        const TileId id{z, x, y};
        // Posts beyond the data repeat its border, so a window that misses the data shows the nearest post.
        PostWindow window = common(info.tile_window(id), world);
        window.i0 = std::min(window.i0, world.i1);
        window.j0 = std::min(window.j0, world.j1);
        window.i1 = std::max(window.i1, window.i0);
        window.j1 = std::max(window.j1, window.j0);
        auto grid = layer_->store().read_window(z, window);
        if (!grid) return grid.error();
        GroundRange range = range_of(*grid, std::ldexp(1.0F, info.base_level - z));
        for (int child = 0; child < 4; ++child) {
          const auto found = all.find({z + 1, 2 * x + (child & 1), 2 * y + (child >> 1)});
          if (found != all.end()) range = joined(range, found->second);
        }
        all[id] = range;
      }
    }
  }
  real_ = std::move(all);
  return {};
}

Result<GroundRange> HeightBounds::real(const TileId& id) const {
  const std::lock_guard lock(mutex_);
  if (real_.empty()) {
    if (auto ok = read_all(); !ok) return ok.error();
  }
  const auto found = real_.find(id);
  if (found == real_.end()) return Error{ErrorCode::kNotFound, "tile " + to_string(id) + " is not a real tile of layer " + layer_->info().name};
  return found->second;
}

Result<GroundRange> HeightBounds::smooth(const TileId& id, const Recipe& recipe) const {
  const LayerInfo& info = layer_->info();
  const int depth = id.z - info.base_level;
  const PostWindow fine = info.tile_window(id);
  PostWindow window{floor_shift(fine.i0, depth), floor_shift(fine.j0, depth), ceil_shift(fine.i1, depth), ceil_shift(fine.j1, depth)};
  const bool is_interpolating = keeps_base_posts(recipe);
  if (!is_interpolating) window = {window.i0 - 3, window.j0 - 3, window.i1 + 3, window.j1 + 3};
  window = common(window, info.world);
  auto grid = layer_->store().read_window(info.base_level, window);
  if (!grid) return grid.error();
  if (is_interpolating && window.width() <= 2 && window.height() <= 2) {
    // Within one cell the surface is bilinear: its corners bound it.
    const float scale = std::ldexp(1.0F, -depth);
    const auto at = [&](std::int64_t i, std::int64_t j) {
      const float u = std::clamp(static_cast<float>(i) * scale - static_cast<float>(window.i0), 0.0F, static_cast<float>(window.width() - 1));
      const float v = std::clamp(static_cast<float>(j) * scale - static_cast<float>(window.j0), 0.0F, static_cast<float>(window.height() - 1));
      const float a = grid->at(window.i0, window.j0), b = grid->at(window.i1, window.j0);
      const float c = grid->at(window.i0, window.j1), d = grid->at(window.i1, window.j1);
      return (a + u * (b - a)) * (1 - v) + (c + u * (d - c)) * v;
    };
    HeightGrid corners{{0, 0, 1, 1}, {at(fine.i0, fine.j0), at(fine.i1, fine.j0), at(fine.i0, fine.j1), at(fine.i1, fine.j1)}, {}};
    const float cells = std::ldexp(static_cast<float>(info.cells_per_tile()), -depth);
    return range_of(corners, cells);
  }
  GroundRange range = range_of(*grid, 1);
  if (recipe.method <= Method::kLsa && recipe.basis == WaveletBasis::kCdf44) {
    // Four-point interpolation overshoots: its limit's absolute values sum to less than 1.3 per direction.
    const float more = 0.35F * (range.high_m - range.low_m);
    range.low_m -= more;
    range.high_m += more;
    for (float* d : {&range.east_min, &range.east_max, &range.south_min, &range.south_max}) *d *= 1.7F;
  }
  return range;
}

Result<DetailLaw> HeightBounds::compute_detail(std::int64_t x, std::int64_t y, const Recipe& recipe) const {
  DetailLaw law{};
  const LayerInfo& info = layer_->info();
  if (recipe.method == Method::kLinear || info.world.width() < 2 || info.world.height() < 2) return law;
  const PostWindow tile = common(info.tile_window({info.base_level, x, y}), info.world);
  if (recipe.method >= Method::kSquareSquare) {
    const PostWindow all = layer_nodes(info.world, recipe.node);
    const auto node = [&](std::int64_t post, std::int64_t first) { return floor_shift(post - first, recipe.node); };
    // Deviations are interpolated between the centres of nodes: one more node on every side.
    const PostWindow nodes = common({node(tile.i0, info.world.i0) - 1, node(tile.j0, info.world.j0) - 1,
                                     node(tile.i1, info.world.i0) + 1, node(tile.j1, info.world.j0) + 1}, all);
    auto heights = layer_->store().read_window(info.base_level, node_heights_window(nodes, info.world, recipe.node));
    if (!heights) return heights.error();
    const NodeCrop crop = estimate_nodes(*heights, info.world, nodes, recipe.node);
    float factor = 1;
    if (recipe.altitude.size() == 4) factor = static_cast<float>(std::max({1.0, std::abs(recipe.altitude[2]), std::abs(recipe.altitude[3])}));
    const std::vector<NodeKind> kinds = recipe.method == Method::kSquareSquare    ? std::vector{NodeKind::kSquare}
                                        : recipe.method == Method::kDiamondSquare ? std::vector{NodeKind::kDiamondCentre, NodeKind::kDiamondEdge}
                                                                                  : std::vector{NodeKind::kWaveletCentre, NodeKind::kWaveletEdge};
    for (const NodeRoughness& one : crop.nodes) {
      for (int n = 0; n < kMaxDepth; ++n) {
        float sum = 0;
        for (const NodeKind kind : kinds) sum += std::pow(node_deviation(one, n + 1, kind), 2.0F);
        law[n] = std::max(law[n], factor * std::sqrt(sum));
      }
    }
    return law;
  }
  auto model = layer_->model(recipe.lsa);
  if (!model) return model.error();
  std::array<float, 3> s0{}, q{};
  for (int band = 0; band < 3; ++band) {
    s0[band] = (*model)->fits[band].s0;
    q[band] = (*model)->fits[band].q;
  }
  if (recipe.method == Method::kLsa) {
    std::array<PostWindow, 3> windows;
    for (int band = 0; band < 3; ++band) {
      const auto size = sigma_map_size(info.world, band);
      // Two entries more: what interpolation between entries and the filters' reach can bring in.
      windows[band] = common({floor_shift(tile.i0 - info.world.i0, 1) - 3, floor_shift(tile.j0 - info.world.j0, 1) - 3,
                              ceil_shift(tile.i1 - info.world.i0, 1) + 3, ceil_shift(tile.j1 - info.world.j0, 1) + 3},
                             {0, 0, size[0] - 1, size[1] - 1});
    }
    auto maps = layer_->sigma_maps().crop(layer_->store(), **model, windows);
    if (!maps) return maps.error();
    for (int band = 0; band < 3; ++band) {
      s0[band] = q[band] = 0;
      for (const float value : (*maps)[band].s0) s0[band] = std::max(s0[band], value);
      for (const float value : (*maps)[band].q) q[band] = std::max(q[band], value);
    }
  }
  for (int n = 0; n < kMaxDepth; ++n) {
    float sum = 0;
    for (int band = 0; band < 3; ++band) {
      const float kappa = recipe.method == Method::kLsa ? (*model)->bands[band].kappa[n] : 1;
      sum += std::pow(kappa * s0[band] * std::pow(q[band], static_cast<float>(n)), 2.0F);
    }
    law[n] = std::sqrt(sum);
  }
  return law;
}

Result<DetailLaw> HeightBounds::detail(std::int64_t x, std::int64_t y, const Recipe& recipe) const {
  const std::string name = recipe_text(recipe);
  {
    const std::lock_guard lock(mutex_);
    const auto& known = details_[name];
    if (const auto found = known.find({x, y}); found != known.end()) return found->second;
  }
  auto law = compute_detail(x, y, recipe);
  if (!law) return law.error();
  const std::lock_guard lock(mutex_);
  if (details_.size() > 64) details_.clear();  // recipes of configurations long gone
  details_[name][{x, y}] = *law;
  return law;
}

Result<double> HeightBounds::base_height_m(double i, double j) const {
  const LayerInfo& info = layer_->info();
  const PostWindow& w = info.world;
  i = std::clamp(i, static_cast<double>(w.i0), static_cast<double>(w.i1));
  j = std::clamp(j, static_cast<double>(w.j0), static_cast<double>(w.j1));
  const std::int64_t i0 = std::clamp(static_cast<std::int64_t>(std::floor(i)), w.i0, std::max(w.i0, w.i1 - 1));
  const std::int64_t j0 = std::clamp(static_cast<std::int64_t>(std::floor(j)), w.j0, std::max(w.j0, w.j1 - 1));
  auto grid = layer_->store().read_window(info.base_level, {i0, j0, i0 + 1, j0 + 1});
  if (!grid) return grid.error();
  const double u = i - static_cast<double>(i0), v = j - static_cast<double>(j0);
  const auto& h = grid->heights_m;
  return (h[0] + u * (h[1] - h[0])) * (1 - v) + (h[2] + u * (h[3] - h[2])) * v;
}

std::shared_ptr<const HeightBounds> HeightBoundsCache::of(const std::shared_ptr<const Layer>& layer) {
  const std::lock_guard lock(mutex_);
  for (auto at = recent_.begin(); at != recent_.end(); ++at) {
    if (&(*at)->layer() != layer.get()) continue;
    recent_.splice(recent_.begin(), recent_, at);
    return recent_.front();
  }
  // An older state of the same layer is not asked for again.
  recent_.remove_if([&](const auto& old) { return old->layer().info().name == layer->info().name; });
  recent_.push_front(std::make_shared<const HeightBounds>(layer));
  if (recent_.size() > kMost) recent_.pop_back();
  return recent_.front();
}

}  // namespace lodestone
