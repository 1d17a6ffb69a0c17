#include "service/ground/ground_maker.h"

#include <fmt/format.h>

#include <algorithm>
#include <cstring>

namespace lodestone {
namespace {

void count_provenance(Ground& ground) {
  ground.provenance_bits = 0;
  for (const Provenance p : {kSurveyed, kFilled, kSynthetic}) {
    if (std::memchr(ground.provenance.data(), p, ground.provenance.size()) != nullptr) {
      ground.provenance_bits |= static_cast<std::uint8_t>(1U << p);
    }
  }
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

// Data posts around the cells of an area `depth` levels below base.
PostWindow coarse_cells(const GroundArea& area, int depth) {
  return {floor_shift(area.x0, depth), floor_shift(area.y0, depth), ceil_shift(area.x0 + area.posts - 1, depth),
          ceil_shift(area.y0 + area.posts - 1, depth)};
}

// Provenance of a synthetic tile: kSynthetic, or kFilled where a data vertex with non-zero bilinear weight is void.
// coarse_void: of the posts `coarse`, empty when none is void.
std::vector<std::uint8_t> synthetic_provenance(const GroundArea& area, int depth, const PostWindow& coarse,
                                               const std::vector<std::uint8_t>& coarse_void) {
  std::vector<std::uint8_t> out(static_cast<std::size_t>(area.posts) * area.posts, kSynthetic);
  if (coarse_void.empty()) return out;
  const auto is_void = [&](std::int64_t i, std::int64_t j) {
    return coarse_void[static_cast<std::size_t>((j - coarse.j0) * coarse.width() + i - coarse.i0)] != 0;
  };
  for (int row = 0; row < area.posts; ++row) {
    const std::int64_t j0 = floor_shift(area.y0 + row, depth);
    const std::int64_t j1 = ceil_shift(area.y0 + row, depth);
    for (int column = 0; column < area.posts; ++column) {
      const std::int64_t i0 = floor_shift(area.x0 + column, depth);
      const std::int64_t i1 = ceil_shift(area.x0 + column, depth);
      if (is_void(i0, j0) || is_void(i1, j0) || is_void(i0, j1) || is_void(i1, j1)) {
        out[static_cast<std::size_t>(row) * area.posts + column] = kFilled;
      }
    }
  }
  return out;
}

// Where a task lies, and its seed.
template <class Task>
void set_place(const LayerInfo& info, std::uint64_t seed, const GroundArea& area, Task& task) {
  task.world = info.world;
  task.base_level = info.base_level;
  task.depth = area.z - info.base_level;
  task.x0 = area.x0;
  task.y0 = area.y0;
  task.posts = area.posts;
  task.seed = seed;
}

// The masks of a task: voids around it, and the layer's masks that the recipe names.
template <class Task>
Result<void> set_masks(const Layer& layer, const Recipe& recipe, Task& task) {
  task.mask_mode = recipe.mask_mode;
  auto voids = void_crop(layer, mask_window(task, 0));
  if (!voids) return voids.error();
  task.void_mask = std::move(*voids);
  const std::vector<std::string> masks = layer.resolve_masks(recipe.masks);
  if (masks.empty()) return {};
  auto level = layer.masks().finest_level(masks);
  if (!level) return level.error();
  auto crop = layer.masks().crop(masks, *level, mask_window(task, *level));
  if (!crop) return crop.error();
  task.mask = std::move(*crop);
  return {};
}

GroundArea area_of(const GroundRequest& request) {
  const std::int64_t cells = request.layer->info().cells_per_tile();
  return {request.id.z, request.id.x * cells, request.id.y * cells, static_cast<int>(cells) + 1};
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
  set_place(info, seed, area, task);
  task.basis = recipe.basis;
  task.lookup = recipe.lookup;
  task.method = recipe.method == Method::kGsa   ? WaveletMethod::kGsa
                : recipe.method == Method::kLsa ? WaveletMethod::kLsa
                                                : WaveletMethod::kLinear;
  if (info.world.width() < 2 || info.world.height() < 2) {
    // A single row or column has no cells, so no variance to continue: linear, on the row beside itself.
    task.method = WaveletMethod::kLinear;
    task.world.i1 = std::max(task.world.i1, task.world.i0 + 1);
    task.world.j1 = std::max(task.world.j1, task.world.j0 + 1);
  }
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
  if (auto ok = set_masks(layer, recipe, task); !ok) return ok.error();
  return prepared;
}

bool is_fractal(const Recipe& recipe, const LayerInfo& info) {
  return recipe.method >= Method::kSquareSquare && info.world.width() >= 2 && info.world.height() >= 2;
}

Result<PreparedFractalTask> prepare_fractal_task(const Layer& layer, const Recipe& recipe, std::uint64_t seed, const GroundArea& area) {
  const LayerInfo& info = layer.info();
  PreparedFractalTask prepared;
  FractalTask& task = prepared.task;
  set_place(info, seed, area, task);
  task.method = recipe.method == Method::kSquareSquare    ? FractalMethod::kSquareSquare
                : recipe.method == Method::kDiamondSquare ? FractalMethod::kDiamondSquare
                                                          : FractalMethod::kFractalWavelet;
  FractalParameters& p = task.parameters;
  p.lookup = recipe.lookup == SigmaLookup::kSmooth ? NodeLookup::kSmooth : NodeLookup::kConstant;
  p.volume = recipe.is_volume_published ? VolumeRule::kPublished : VolumeRule::kTriangle;
  p.erosion = recipe.has_erosion;
  if (recipe.water_m) p.water_m = static_cast<float>(*recipe.water_m);
  if (recipe.cap_m) p.cap_m = static_cast<float>(*recipe.cap_m);
  if (recipe.altitude.size() == 4) {
    p.altitude = AltitudeRule{static_cast<float>(recipe.altitude[0]), static_cast<float>(recipe.altitude[1]),
                              static_cast<float>(recipe.altitude[2]), static_cast<float>(recipe.altitude[3])};
  }
  auto coarse = layer.store().read_window(info.base_level, coarse_window(task));
  if (!coarse) return coarse.error();
  task.coarse_m = std::move(coarse->heights_m);
  const PostWindow nodes = node_window(task, recipe.node);
  auto heights = layer.store().read_window(info.base_level, node_heights_window(nodes, info.world, recipe.node));
  if (!heights) return heights.error();
  task.nodes = estimate_nodes(*heights, info.world, nodes, recipe.node);
  if (auto ok = set_masks(layer, recipe, task); !ok) return ok.error();
  const PostWindow cells = coarse_cells(area, task.depth);
  auto any = layer.store().has_voids(cells);
  if (!any) return any.error();
  if (*any) {
    auto around = layer.store().read_window(info.base_level, cells);
    if (!around) return around.error();
    prepared.coarse_void = std::move(around->is_void);
  }
  return prepared;
}

Result<std::unique_ptr<GroundMaker>> GroundMaker::create(std::shared_ptr<Device> device) {
  if (!device) {
    return std::unique_ptr<GroundMaker>(new GroundMaker(make_host_wavelet_synthesis(), make_host_fractal_synthesis()));
  }
  auto wavelet = make_device_wavelet_synthesis(device);
  if (!wavelet) return wavelet.error();
  auto fractal = make_device_fractal_synthesis(std::move(device));
  if (!fractal) return fractal.error();
  return std::unique_ptr<GroundMaker>(new GroundMaker(std::move(*wavelet), std::move(*fractal)));
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

namespace {

// Prepares the requests `which`, runs them as one batch and gives heights and provenance back; failures go to `grounds`.
template <class Prepared, class Prepare, class Synthesis>
void run_batch(std::span<const GroundRequest> requests, std::span<const std::size_t> which, Prepare prepare, Synthesis& synthesis,
               std::vector<Result<Ground>>& grounds) {
  std::vector<decltype(Prepared::task)> tasks;
  std::vector<std::vector<std::uint8_t>> provenances;
  std::vector<std::size_t> sources;
  for (const std::size_t n : which) {
    const GroundRequest& request = requests[n];
    const GroundArea area = area_of(request);
    Result<Prepared> prepared = prepare(*request.layer, request.recipe, request.seed, area);
    if (!prepared) {
      grounds[n] = std::move(prepared.error()).within("preparing tile " + to_string(request.id));
      continue;
    }
    PostWindow coarse = coarse_cells(area, prepared->task.depth);
    if constexpr (std::is_same_v<Prepared, PreparedTask>) coarse = coarse_window(prepared->task);
    provenances.push_back(synthetic_provenance(area, prepared->task.depth, coarse, prepared->coarse_void));
    tasks.push_back(std::move(prepared->task));
    sources.push_back(n);
  }
  if (tasks.empty()) return;
  std::vector<std::vector<float>> heights(tasks.size());
  if (auto ok = synthesis.run(tasks, heights); !ok) {
    for (const std::size_t n : sources) grounds[n] = ok.error();
    return;
  }
  for (std::size_t t = 0; t < tasks.size(); ++t) {
    const GroundRequest& request = requests[sources[t]];
    const LayerInfo& info = request.layer->info();
    Ground ground;
    ground.posts = info.posts_per_tile;
    ground.heights_m = std::move(heights[t]);
    ground.provenance = std::move(provenances[t]);
    extend_beyond_data(info.tile_window(request.id), info.world_at(request.id.z), ground);
    count_provenance(ground);
    grounds[sources[t]] = std::move(ground);
  }
}

}  // namespace

std::vector<Result<Ground>> GroundMaker::make(std::span<const GroundRequest> requests) {
  std::vector<Result<Ground>> grounds(requests.size(), Result<Ground>(Error{ErrorCode::kInternal, "tile was not made"}));
  std::vector<std::size_t> wavelet;
  std::vector<std::size_t> fractal;
  for (std::size_t n = 0; n < requests.size(); ++n) {
    const GroundRequest& request = requests[n];
    const LayerInfo& info = request.layer->info();
    if (!info.has_tile(request.id)) {
      grounds[n] = Error{ErrorCode::kNotFound, fmt::format("tile {} is outside layer {}", to_string(request.id), info.name)};
    } else if (request.id.z <= info.base_level) {
      grounds[n] = make_real(request);
    } else if (is_fractal(request.recipe, info)) {
      fractal.push_back(n);
    } else {
      wavelet.push_back(n);
    }
  }
  // Equal depths next to each other, so that they share launches.
  for (auto* list : {&wavelet, &fractal}) {
    std::stable_sort(list->begin(), list->end(), [&](std::size_t a, std::size_t b) { return requests[a].id.z < requests[b].id.z; });
  }
  run_batch<PreparedTask>(requests, wavelet, prepare_task, *wavelet_, grounds);
  run_batch<PreparedFractalTask>(requests, fractal, prepare_fractal_task, *fractal_, grounds);
  return grounds;
}

}  // namespace lodestone
