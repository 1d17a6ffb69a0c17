#include "service/ground/ground_maker.h"

#include <fmt/format.h>

#include <algorithm>

namespace lodestone {
namespace {

void count_provenance(Ground& ground) {
  ground.provenance_bits = 0;
  for (const std::uint8_t p : ground.provenance) ground.provenance_bits |= static_cast<std::uint8_t>(1U << p);
}

// Data cells of `pixels` (level 0, relative to the world's corner, mirrored beyond it) with a void corner as 255.
Result<std::optional<MaskCrop>> void_crop(const Layer& layer, const PostWindow& pixels) {
  const PostWindow& world = layer.info().world;
  const PostWindow corners{world.i0 + pixels.i0, world.j0 + pixels.j0, world.i0 + pixels.i1 + 1, world.j0 + pixels.j1 + 1};
  auto any = layer.store().has_voids(corners);
  if (!any) return any.error();
  if (!*any) return std::optional<MaskCrop>();
  auto posts = layer.store().read_window(layer.info().base_level, corners);
  if (!posts) return posts.error();
  if (posts->is_void.empty()) return std::optional<MaskCrop>();
  MaskCrop crop{0, pixels.i0, pixels.j0, static_cast<int>(pixels.width()), static_cast<int>(pixels.height()), {}};
  crop.pixels.reserve(static_cast<std::size_t>(pixels.width() * pixels.height()));
  for (std::int64_t j = corners.j0; j < corners.j1; ++j) {
    for (std::int64_t i = corners.i0; i < corners.i1; ++i) {
      const bool is_void = posts->void_at(i, j) || posts->void_at(i + 1, j) || posts->void_at(i, j + 1) || posts->void_at(i + 1, j + 1);
      crop.pixels.push_back(is_void ? 255 : 0);
    }
  }
  return std::optional<MaskCrop>(std::move(crop));
}

// Provenance of a synthetic tile: kSynthetic, or kFilled where a data vertex with non-zero bilinear weight is void.
std::vector<std::uint8_t> synthetic_provenance(const WaveletTask& task, const std::vector<std::uint8_t>& coarse_void) {
  std::vector<std::uint8_t> out(static_cast<std::size_t>(task.posts) * task.posts, kSynthetic);
  if (coarse_void.empty()) return out;
  const PostWindow coarse = coarse_window(task);
  const auto is_void = [&](std::int64_t i, std::int64_t j) {
    return coarse_void[static_cast<std::size_t>((j - coarse.j0) * coarse.width() + i - coarse.i0)] != 0;
  };
  for (int row = 0; row < task.posts; ++row) {
    const std::int64_t y = task.y0 + row;
    for (int column = 0; column < task.posts; ++column) {
      const std::int64_t x = task.x0 + column;
      const std::int64_t i0 = floor_shift(x, task.depth);
      const std::int64_t i1 = ceil_shift(x, task.depth);
      const std::int64_t j0 = floor_shift(y, task.depth);
      const std::int64_t j1 = ceil_shift(y, task.depth);
      if (is_void(i0, j0) || is_void(i1, j0) || is_void(i0, j1) || is_void(i1, j1)) {
        out[static_cast<std::size_t>(row) * task.posts + column] = kFilled;
      }
    }
  }
  return out;
}

}  // namespace

void extend_beyond_data(const PostWindow& window, const PostWindow& world, Ground& ground) {
  if (window.i0 >= world.i0 && window.j0 >= world.j0 && window.i1 <= world.i1 && window.j1 <= world.j1) return;
  const std::int64_t width = window.width();
  // Source column and row of each post, counted in the tile; the tile holds at least one post of the data.
  const auto inside_column = [&](std::int64_t i) { return std::clamp(i, std::max(window.i0, world.i0), std::min(window.i1, world.i1)) - window.i0; };
  const auto inside_row = [&](std::int64_t j) { return std::clamp(j, std::max(window.j0, world.j0), std::min(window.j1, world.j1)) - window.j0; };
  for (std::int64_t j = window.j0; j <= window.j1; ++j) {
    for (std::int64_t i = window.i0; i <= window.i1; ++i) {
      if (world.contains(i, j)) continue;
      const auto target = static_cast<std::size_t>((j - window.j0) * width + (i - window.i0));
      ground.heights_m[target] = ground.heights_m[static_cast<std::size_t>(inside_row(j) * width + inside_column(i))];
      ground.provenance[target] = kFilled;
    }
  }
}

Result<PreparedTask> prepare_task(const Layer& layer, const Recipe& recipe, std::uint64_t seed, const GroundArea& area) {
  const LayerInfo& info = layer.info();
  PreparedTask prepared;
  WaveletTask& task = prepared.task;
  task.world = info.world;
  task.base_level = info.base_level;
  task.depth = area.z - info.base_level;
  task.x0 = area.x0;
  task.y0 = area.y0;
  task.posts = area.posts;
  task.seed = seed;
  task.basis = recipe.basis;
  task.lookup = recipe.lookup;
  task.mask_mode = recipe.mask_mode;
  task.method = recipe.method == Method::kGsa   ? WaveletMethod::kGsa
                : recipe.method == Method::kLsa ? WaveletMethod::kLsa
                                                : WaveletMethod::kLinear;
  auto coarse = layer.store().read_window(info.base_level, coarse_window(task));
  if (!coarse) return coarse.error();
  task.coarse_m = std::move(coarse->heights_m);
  prepared.coarse_void = std::move(coarse->is_void);
  if (task.method == WaveletMethod::kLinear) return prepared;

  LsaParameters parameters = recipe.lsa;
  if (task.method == WaveletMethod::kGsa) parameters = LsaParameters{.fit = recipe.lsa.fit};
  auto model = layer.model(parameters);
  if (!model) return model.error();
  task.bands = (*model)->bands;
  if (task.method == WaveletMethod::kLsa) {
    std::array<PostWindow, 3> windows;
    for (int band = 0; band < 3; ++band) {
      const auto size = sigma_map_size(info.world, band);
      task.maps[band].map_width = size[0];
      task.maps[band].map_height = size[1];
      windows[band] = size[0] > 0 && size[1] > 0 ? sigma_window(task, band) : PostWindow{0, 0, -1, -1};
    }
    auto maps = layer.sigma_maps().crop(layer.store(), **model, windows);
    if (!maps) return maps.error();
    task.maps = std::move(*maps);
  }
  auto voids = void_crop(layer, mask_window(task, 0));
  if (!voids) return voids.error();
  task.void_mask = std::move(*voids);
  const std::vector<std::string> masks = layer.resolve_masks(recipe.masks);
  if (!masks.empty()) {
    auto level = layer.masks().finest_level(masks);
    if (!level) return level.error();
    auto crop = layer.masks().crop(masks, *level, mask_window(task, *level));
    if (!crop) return crop.error();
    task.mask = std::move(*crop);
  }
  return prepared;
}

Result<std::unique_ptr<GroundMaker>> GroundMaker::create(std::shared_ptr<Device> device) {
  if (!device) return std::unique_ptr<GroundMaker>(new GroundMaker(make_host_wavelet_synthesis()));
  auto wavelet = make_device_wavelet_synthesis(std::move(device));
  if (!wavelet) return wavelet.error();
  return std::unique_ptr<GroundMaker>(new GroundMaker(std::move(*wavelet)));
}

Result<void> GroundMaker::probe(const WaveletTask& task) {
  std::vector<float> heights;
  return wavelet_->run(std::span(&task, 1), std::span(&heights, 1));
}

Result<Ground> GroundMaker::make_real(const GroundRequest& request) {
  const LayerInfo& info = request.layer->info();
  const PostWindow window = info.tile_window(request.id);
  auto grid = request.layer->store().read_window(request.id.z, window);
  if (!grid) return grid.error();
  Ground ground;
  ground.posts = info.posts_per_tile;
  ground.heights_m = std::move(grid->heights_m);
  ground.provenance = std::move(grid->is_void);  // 1 = void = kFilled
  if (ground.provenance.empty()) ground.provenance.assign(ground.heights_m.size(), kSurveyed);
  extend_beyond_data(window, info.world_at(request.id.z), ground);
  count_provenance(ground);
  return ground;
}

void GroundMaker::make_wavelet(std::span<const GroundRequest> requests, std::span<const std::size_t> which,
                               std::vector<Result<Ground>>& grounds) {
  std::vector<WaveletTask> tasks;
  std::vector<std::vector<std::uint8_t>> coarse_voids;
  std::vector<std::size_t> sources;
  for (const std::size_t n : which) {
    const GroundRequest& request = requests[n];
    const std::int64_t cells = request.layer->info().cells_per_tile();
    auto prepared = prepare_task(*request.layer, request.recipe, request.seed,
                                 {request.id.z, request.id.x * cells, request.id.y * cells, static_cast<int>(cells) + 1});
    if (!prepared) {
      grounds[n] = std::move(prepared.error()).within("preparing tile " + to_string(requests[n].id));
      continue;
    }
    tasks.push_back(std::move(prepared->task));
    coarse_voids.push_back(std::move(prepared->coarse_void));
    sources.push_back(n);
  }
  if (tasks.empty()) return;
  std::vector<std::vector<float>> heights(tasks.size());
  if (auto ok = wavelet_->run(tasks, heights); !ok) {
    for (const std::size_t n : sources) grounds[n] = ok.error();
    return;
  }
  for (std::size_t t = 0; t < tasks.size(); ++t) {
    const GroundRequest& request = requests[sources[t]];
    const LayerInfo& info = request.layer->info();
    Ground ground;
    ground.posts = info.posts_per_tile;
    ground.heights_m = std::move(heights[t]);
    ground.provenance = synthetic_provenance(tasks[t], coarse_voids[t]);
    extend_beyond_data(info.tile_window(request.id), info.world_at(request.id.z), ground);
    count_provenance(ground);
    grounds[sources[t]] = std::move(ground);
  }
}

std::vector<Result<Ground>> GroundMaker::make(std::span<const GroundRequest> requests) {
  std::vector<Result<Ground>> grounds(requests.size(), Result<Ground>(Error{ErrorCode::kInternal, "tile was not made"}));
  std::vector<std::size_t> wavelet;
  for (std::size_t n = 0; n < requests.size(); ++n) {
    const GroundRequest& request = requests[n];
    const LayerInfo& info = request.layer->info();
    if (!info.has_tile(request.id)) {
      grounds[n] = Error{ErrorCode::kNotFound, fmt::format("tile {} is outside layer {}", to_string(request.id), info.name)};
    } else if (request.id.z <= info.base_level) {
      grounds[n] = make_real(request);
    } else if (request.recipe.method <= Method::kLsa) {
      wavelet.push_back(n);
    } else {
      grounds[n] = Error{ErrorCode::kUnsupported, fmt::format("method {} is not available in this build", to_string(request.recipe.method))};
    }
  }
  // Equal depths next to each other, so that they share launches.
  std::stable_sort(wavelet.begin(), wavelet.end(),
                   [&](std::size_t a, std::size_t b) { return requests[a].id.z < requests[b].id.z; });
  make_wavelet(requests, wavelet, grounds);
  return grounds;
}

}  // namespace lodestone
