// Ingest in passes: read (rasters to base tiles), fill (voids), levels (analysis), roughness (hook), publish
// (rename).

#include "storage/dem/ingest.h"

#include <xxhash.h>

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <limits>

#include "storage/dem/layer_files.h"
#include "storage/dem/lmdb_env.h"
#include "storage/dem/mask_files.h"
#include "storage/dem/parallel.h"
#include "storage/dem/raster_source.h"
#include "storage/dem/tile_codec.h"
#include "storage/dem/tile_reader.h"
#include "storage/dem/void_fill.h"

namespace lodestone {
namespace {

namespace fs = std::filesystem;

constexpr std::size_t kCommitBytes = std::size_t{16} << 20;
constexpr std::size_t kReadBudgetBytes = std::size_t{64} << 20;  // of all workers' read buffers together
constexpr std::size_t kDecodedBytes = std::size_t{64} << 20;
constexpr std::size_t kMaxWaiting = 64;  // encoded tiles between workers and the writer
constexpr int kOrderBlock = 8;  // tiles are visited in blocks of 8 x 8, so that neighbours are still decoded

struct TileOutput {
  KeyValue item;
  std::size_t index = 0;  // row-major among the level's tiles
  XXH128_hash_t digest{};
  std::uint8_t void_state = 0;  // 0 no voids, 1 some, 2 all
  std::int64_t void_posts = 0;  // of the posts that the tile owns
  float min_m = 0, max_m = 0;
  std::vector<FillBlocks::Part> parts;
  LevelVariance sums{};  // sums of squares and counts
};

// Posts that tile `id` counts for the layer: all but those that it shares with its eastern and southern
// neighbours.
PostWindow owned_part(const LayerInfo& layer, const TileId& id, const PostWindow& stored) {
  const PostWindow tiles = layer.tiles_at(id.z);
  const std::int64_t n = layer.cells_per_tile();
  return {stored.i0, stored.j0, id.x < tiles.i1 ? std::min(stored.i1, (id.x + 1) * n - 1) : stored.i1,
          id.y < tiles.j1 ? std::min(stored.j1, (id.y + 1) * n - 1) : stored.j1};
}

XXH128_hash_t digest_of(const HeightGrid& tile) {
  const XXH128_hash_t heights = XXH3_128bits(tile.heights_m.data(), tile.heights_m.size() * sizeof(float));
  return XXH3_128bits_withSeed(tile.is_void.data(), tile.is_void.size(),
                               heights.low64 ^ (heights.high64 * 3));
}

std::vector<TileId> visiting_order(int level, const PostWindow& tiles) {
  std::vector<TileId> order;
  order.reserve(static_cast<std::size_t>(tiles.width() * tiles.height()));
  for (std::int64_t by = tiles.j0; by <= tiles.j1; by += kOrderBlock) {
    for (std::int64_t bx = tiles.i0; bx <= tiles.i1; bx += kOrderBlock) {
      for (std::int64_t y = by; y <= std::min(by + kOrderBlock - 1, tiles.j1); ++y) {
        for (std::int64_t x = bx; x <= std::min(bx + kOrderBlock - 1, tiles.i1); ++x)
          order.push_back({level, x, y});
      }
    }
  }
  return order;
}

// Puts of many tiles, a transaction per kCommitBytes.
class Batch {
 public:
  explicit Batch(LmdbEnv& env) : env_(env) {}
  Result<void> add(KeyValue item) {
    bytes_ += item.value.size() + sizeof item + item.key.capacity();
    items_.push_back(std::move(item));
    return bytes_ < kCommitBytes ? Result<void>() : flush();
  }
  Result<void> flush() {
    if (items_.empty()) return {};
    auto ok = env_.write(items_);
    items_.clear();
    bytes_ = 0;
    return ok;
  }

 private:
  LmdbEnv& env_;
  std::vector<KeyValue> items_;
  std::size_t bytes_ = 0;
};

void add_coefficients(const std::vector<float>& detail, const std::vector<std::uint8_t>& is_void,
                      const PostWindow& all, const PostWindow& owned, BandVariance& sum) {
  for (std::int64_t j = owned.j0; j <= owned.j1; ++j) {
    double row_sum = 0;
    const std::size_t from = static_cast<std::size_t>((j - all.j0) * all.width() + owned.i0 - all.i0);
    for (std::size_t k = from; k < from + static_cast<std::size_t>(owned.width()); ++k) {
      if (!is_void.empty() && is_void[k] != 0) continue;
      row_sum += static_cast<double>(detail[k]) * static_cast<double>(detail[k]);
      ++sum.count;
    }
    sum.variance_m2 += row_sum;
  }
}

class Ingest {
 public:
  Ingest(const IngestOptions& options, const IngestKernels& kernels, RasterPlan plan,
         std::shared_ptr<LmdbEnv> env, const std::function<void(const IngestProgress&)>& progress)
      : options_(options),
        kernels_(kernels),
        plan_(std::move(plan)),
        env_(std::move(env)),
        progress_(progress),
        threads_(std::clamp(options.threads, 1, 64)),
        blocks_(plan_.info.world) {}

  Result<LayerInfo> run() {
    if (auto ok = read(); !ok) return ok.error();
    if (auto ok = fill(); !ok) return ok.error();
    if (auto ok = levels(); !ok) return ok.error();
    set_digest();
    if (auto ok = roughness(); !ok) return ok.error();
    return plan_.info;
  }

 private:
  LayerInfo& info() { return plan_.info; }
  void report(const char* phase, double from, double to, double done, double all) const {
    if (progress_) progress_({phase, from + (to - from) * (all > 0 ? done / all : 1)});
  }

  // Rasters to base tiles. A job reads a stretch of tiles at once, so that a raster's blocks are decoded
  // about once.
  Result<void> read() {
    const int z = info().base_level;
    const PostWindow tiles = info().tiles_at(z);
    const std::int64_t n = info().cells_per_tile();
    const auto budget_posts =
        static_cast<double>(std::max<std::size_t>(kReadBudgetBytes / static_cast<std::size_t>(threads_),
                                                  std::size_t{4} << 20)) /
        4;
    const bool has_strips = info().grid == GridKind::kNative &&
                            std::any_of(plan_.rasters.begin(), plan_.rasters.end(),
                                        [](const PlannedRaster& r) { return r.block_width >= r.width; });
    // About four jobs a thread where that leaves several tiles a job.
    const double share =
        std::max(1.0, static_cast<double>(tiles.width() * tiles.height()) / (4.0 * threads_));
    std::int64_t job_width = 0, job_height = 0;  // tiles
    if (has_strips) {
      job_width = std::min(
          tiles.width(),
          std::max<std::int64_t>(1, static_cast<std::int64_t>(budget_posts / static_cast<double>(n + 1) /
                                                              static_cast<double>(n))));
      const auto rows = static_cast<std::int64_t>(budget_posts / static_cast<double>(job_width * n + 1) /
                                                  static_cast<double>(n));
      job_height = std::max<std::int64_t>(
          1, std::min(rows, static_cast<std::int64_t>(share / static_cast<double>(job_width))));
    } else {
      const double side = std::min(std::sqrt(budget_posts) / static_cast<double>(n), std::sqrt(share));
      job_width = job_height = std::max<std::int64_t>(1, static_cast<std::int64_t>(side));
    }
    const std::int64_t jobs_x = (tiles.width() + job_width - 1) / job_width;
    const std::int64_t jobs_y = (tiles.height() + job_height - 1) / job_height;

    const auto tile_count = static_cast<std::size_t>(tiles.width() * tiles.height());
    digests_.resize(tile_count);
    void_state_.resize(tile_count);
    float min_m = std::numeric_limits<float>::infinity(), max_m = -min_m;
    std::vector<std::optional<RasterReader>> readers(static_cast<std::size_t>(threads_));
    std::vector<std::vector<float>> buffers(static_cast<std::size_t>(threads_));
    Batch batch(*env_);
    std::size_t done = 0;
    auto ok = run_jobs<TileOutput>(
        jobs_x * jobs_y, threads_, kMaxWaiting,
        [&](std::int64_t job, int worker, const std::function<bool(TileOutput &&)>& emit) -> Result<void> {
          auto& reader = readers[static_cast<std::size_t>(worker)];
          if (!reader) {
            auto opened = RasterReader::open(plan_);
            if (!opened) return opened.error();
            reader.emplace(std::move(*opened));
          }
          auto& heights = buffers[static_cast<std::size_t>(worker)];
          const std::int64_t x0 = tiles.i0 + job % jobs_x * job_width,
                             x1 = std::min(x0 + job_width - 1, tiles.i1);
          const std::int64_t y0 = tiles.j0 + job / jobs_x * job_height,
                             y1 = std::min(y0 + job_height - 1, tiles.j1);
          const PostWindow window = intersection({x0 * n, y0 * n, (x1 + 1) * n, (y1 + 1) * n}, info().world);
          if (auto read = reader->read(window, heights); !read) return read;
          for (std::int64_t y = y0; y <= y1; ++y) {
            for (std::int64_t x = x0; x <= x1; ++x) {
              if (!emit(cut_tile({z, x, y}, window, heights))) return {};
            }
          }
          return {};
        },
        [&](TileOutput&& tile) -> Result<void> {
          digests_[tile.index] = tile.digest;
          void_state_[tile.index] = tile.void_state;
          info().void_posts += tile.void_posts;
          min_m = std::min(min_m, tile.min_m);
          max_m = std::max(max_m, tile.max_m);
          blocks_.add(tile.parts);
          report("read", 0, 0.45, static_cast<double>(++done), static_cast<double>(tile_count));
          return batch.add(std::move(tile.item));
        });
    if (!ok) return ok;
    has_data_ = min_m <= max_m;
    info().height_min_m = has_data_ ? static_cast<double>(min_m) : 0;
    info().height_max_m = has_data_ ? static_cast<double>(max_m) : 0;
    return batch.flush();
  }

  TileOutput cut_tile(const TileId& id, const PostWindow& window, const std::vector<float>& heights) {
    HeightGrid tile;
    tile.window = stored_window(info(), id);
    const auto width = static_cast<std::size_t>(tile.window.width());
    tile.heights_m.reserve(width * static_cast<std::size_t>(tile.window.height()));
    for (std::int64_t j = tile.window.j0; j <= tile.window.j1; ++j) {
      const float* row =
          &heights[static_cast<std::size_t>((j - window.j0) * window.width() + tile.window.i0 - window.i0)];
      tile.heights_m.insert(tile.heights_m.end(), row, row + width);
    }
    TileOutput out;
    out.index = index_of(id);
    const PostWindow owned = owned_part(info(), id, tile.window);
    out.parts = blocks_.sums_of(tile.window, tile.heights_m, owned);
    out.min_m = std::numeric_limits<float>::infinity();
    out.max_m = -out.min_m;
    std::int64_t voids = 0;
    for (const float h : tile.heights_m) {
      voids += std::isnan(h) ? 1 : 0;
      out.min_m = h < out.min_m ? h : out.min_m;
      out.max_m = h > out.max_m ? h : out.max_m;
    }
    if (voids > 0) {
      tile.is_void.resize(tile.heights_m.size());
      for (std::size_t k = 0; k < tile.heights_m.size(); ++k) {
        if (!std::isnan(tile.heights_m[k])) continue;
        tile.is_void[k] = 1;
        tile.heights_m[k] = 0;
      }
      for (std::int64_t j = owned.j0; j <= owned.j1; ++j) {
        for (std::int64_t i = owned.i0; i <= owned.i1; ++i) out.void_posts += tile.is_void[tile.index(i, j)];
      }
      out.void_state = voids == static_cast<std::int64_t>(tile.heights_m.size()) ? 2 : 1;
    }
    out.digest = digest_of(tile);
    out.item.key = tile_key(id);
    out.item.value = encode_tile(tile, out.item.key);
    return out;
  }

  std::size_t index_of(const TileId& id) {
    const PostWindow tiles = info().tiles_at(id.z);
    return static_cast<std::size_t>((id.y - tiles.j0) * tiles.width() + id.x - tiles.i0);
  }

  // Heights for the void posts, from surveyed ones. Without any surveyed post they stay 0.
  Result<void> fill() {
    if (!has_data_) return {};
    blocks_.finish();
    const int z = info().base_level;
    std::vector<TileId> order = visiting_order(z, info().tiles_at(z));
    std::erase_if(order, [&](const TileId& id) { return void_state_[index_of(id)] == 0; });
    const TileReader reader(env_, info(), kDecodedBytes);
    Batch batch(*env_);
    std::size_t done = 0;
    auto ok = run_jobs<TileOutput>(
        static_cast<std::int64_t>(order.size()), threads_, kMaxWaiting,
        [&](std::int64_t job, int, const std::function<bool(TileOutput &&)>& emit) -> Result<void> {
          const TileId id = order[static_cast<std::size_t>(job)];
          auto tile = reader.window(z, stored_window(info(), id));
          if (!tile) return tile.error();
          HeightGrid around;
          around.window = intersection({tile->window.i0 - kFillReach, tile->window.j0 - kFillReach,
                                        tile->window.i1 + kFillReach, tile->window.j1 + kFillReach},
                                       info().world);
          if (is_all_void(around.window)) {
            around.window = tile->window;
            around.heights_m = tile->heights_m;
            around.is_void = tile->is_void;
          } else {
            auto wide = reader.window(z, around.window);
            if (!wide) return wide.error();
            around = std::move(*wide);
          }
          fill_voids(*tile, around, blocks_);
          TileOutput out;
          out.index = index_of(id);
          out.digest = digest_of(*tile);
          out.item.key = tile_key(id);
          out.item.value = encode_tile(*tile, out.item.key);
          emit(std::move(out));
          return {};
        },
        [&](TileOutput&& tile) -> Result<void> {
          digests_[tile.index] = tile.digest;
          report("fill", 0.45, 0.6, static_cast<double>(++done), static_cast<double>(order.size()));
          return batch.add(std::move(tile.item));
        });
    if (!ok) return ok;
    return batch.flush();
  }

  bool is_all_void(const PostWindow& window) {
    const std::int64_t n = info().cells_per_tile();
    const PostWindow tiles = info().tiles_at(info().base_level);
    for (std::int64_t y = std::max(window.j0 / n, tiles.j0); y <= std::min(window.j1 / n, tiles.j1); ++y) {
      for (std::int64_t x = std::max(window.i0 / n, tiles.i0); x <= std::min(window.i1 / n, tiles.i1); ++x) {
        if (void_state_[index_of({info().base_level, x, y})] != 2) return false;
      }
    }
    return true;
  }

  // Levels base-1 .. 0 from the one below, and the variances of as many levels as the world is wide.
  Result<void> levels() {
    const std::int64_t cells = std::min(info().world.width(), info().world.height()) - 1;
    const int analysed = cells > 0 ? std::bit_width(static_cast<std::uint64_t>(cells)) - 1 : 0;
    const double all_tiles = std::max(1.0, static_cast<double>(digests_.size()) / 3);
    double done = 0;
    const TileReader reader(env_, info(), kDecodedBytes);
    for (int z = info().base_level - 1; z >= 0; --z) {
      const PostWindow tiles = info().tiles_at(z);
      const PostWindow fine_world = info().world_at(z + 1);
      const std::vector<TileId> order = visiting_order(z, tiles);
      std::vector<LevelVariance> sums(order.size());
      Batch batch(*env_);
      auto ok = run_jobs<TileOutput>(
          static_cast<std::int64_t>(order.size()), threads_, kMaxWaiting,
          [&](std::int64_t job, int, const std::function<bool(TileOutput &&)>& emit) -> Result<void> {
            const TileId id = order[static_cast<std::size_t>(job)];
            HeightGrid tile;
            tile.window = stored_window(info(), id);
            auto fine = reader.window(z + 1, kernels_.analysis_window(tile.window, fine_world));
            if (!fine) return fine.error();
            AnalysisStep step = kernels_.analyse(*fine, fine_world, tile.window);
            TileOutput out;
            out.index = index_of(id);
            const PostWindow owned = owned_part(info(), id, tile.window);
            for (std::size_t t = 0; t < 3; ++t)
              add_coefficients(step.detail_m[t], step.detail_void[t], tile.window, owned, out.sums[t]);
            tile.heights_m = std::move(step.low_m);
            tile.is_void = std::move(step.low_void);
            out.item.key = tile_key(id);
            out.item.value = encode_tile(tile, out.item.key);
            emit(std::move(out));
            return {};
          },
          [&](TileOutput&& tile) -> Result<void> {
            sums[tile.index] = tile.sums;
            report("levels", 0.6, 0.85, std::min(++done, all_tiles), all_tiles);
            return batch.add(std::move(tile.item));
          });
      if (!ok) return ok;
      if (auto flushed = batch.flush(); !flushed) return flushed;
      if (static_cast<int>(info().variances.size()) < analysed) add_level(sums);
    }

    // What is left of the world at level 0 fits in memory.
    PostWindow world = info().world_at(0);
    auto grid = reader.window(0, world);
    if (!grid) return grid.error();
    while (static_cast<int>(info().variances.size()) < analysed) {
      const PostWindow coarse = coarse_world(world);
      AnalysisStep step = kernels_.analyse(*grid, world, coarse);
      LevelVariance sum{};
      for (std::size_t t = 0; t < 3; ++t)
        add_coefficients(step.detail_m[t], step.detail_void[t], coarse, coarse, sum[t]);
      add_level({sum});
      *grid = HeightGrid{coarse, std::move(step.low_m), std::move(step.low_void)};
      world = coarse;
    }
    return {};
  }

  // Tiles in row-major order, whatever thread made them first.
  void add_level(const std::vector<LevelVariance>& sums) {
    LevelVariance level{};
    for (const LevelVariance& tile : sums) {
      for (std::size_t t = 0; t < 3; ++t) {
        level[t].variance_m2 += tile[t].variance_m2;
        level[t].count += tile[t].count;
      }
    }
    for (BandVariance& band : level)
      band.variance_m2 = band.count > 0 ? band.variance_m2 / static_cast<double>(band.count) : 0;
    info().variances.push_back(level);
  }

  // Of everything that tiles depend on: heights, flags, grid and place.
  void set_digest() {
    LayerInfo placed = info();
    placed.name.clear();
    placed.sources.clear();
    const std::string options = layer_info_json(placed) + ";band=" + std::to_string(options_.band) +
                                ";unit=" + options_.unit + ";format=" + std::to_string(kFormatVersion);
    const XXH128_hash_t tiles = XXH3_128bits(digests_.data(), digests_.size() * sizeof(XXH128_hash_t));
    const XXH128_hash_t all =
        XXH3_128bits_withSeed(options.data(), options.size(), tiles.low64 ^ (tiles.high64 * 3));
    XXH128_canonical_t bytes;
    XXH128_canonicalFromHash(&bytes, all);
    constexpr const char* kHex = "0123456789abcdef";
    for (const unsigned char b : bytes.digest) {
      info().source_digest += kHex[b >> 4];
      info().source_digest += kHex[b & 15];
    }
  }

  Result<void> roughness() {
    report("roughness", 0.85, 0.97, 0, 1);
    std::string text;
    if (kernels_.finish) {
      const auto store = store_on(env_, info(), "", kDecodedBytes);
      auto made = kernels_.finish(*store);
      if (!made) return std::move(made.error()).within("modelling the roughness of layer " + info().name);
      text = std::move(*made);
    }
    const KeyValue items[] = {{kInfoKey, encode_text(layer_info_json(info()), kInfoKey)},
                              {kRoughnessKey, encode_text(text, kRoughnessKey)}};
    if (auto ok = env_->write(items); !ok) return ok;
    report("publish", 0.97, 1, 0, 1);
    return env_->sync();
  }

  const IngestOptions& options_;
  const IngestKernels& kernels_;
  RasterPlan plan_;
  const std::shared_ptr<LmdbEnv> env_;
  const std::function<void(const IngestProgress&)>& progress_;
  const int threads_;
  FillBlocks blocks_;
  bool has_data_ = false;
  std::vector<XXH128_hash_t> digests_;  // of base tiles, row-major
  std::vector<std::uint8_t> void_state_;
};

// Removes generations that CURRENT does not name and unfinished files: what a killed ingest left. The lock is
// held.
std::int64_t sweep(const fs::path& directory, const std::string& current) {
  std::int64_t newest = 0;
  std::error_code ec;
  std::vector<fs::path> leftovers;
  for (fs::directory_iterator it(directory, ec), end; !ec && it != end; it.increment(ec)) {
    const std::string name = it->path().filename().string();
    if (name.rfind("gen-", 0) == 0)
      newest = std::max(newest, static_cast<std::int64_t>(std::strtoll(name.c_str() + 4, nullptr, 10)));
    if ((name.rfind("gen-", 0) == 0 && name != current) || name == "CURRENT.tmp")
      leftovers.push_back(it->path());
  }
  for (const fs::path& path : leftovers) fs::remove_all(path, ec);
  return newest;
}

// A map large enough for every tile incompressible, twice over (values are rewritten while others read).
std::size_t map_bytes_for(const LayerInfo& info) {
  const PostWindow tiles = info.tiles_at(info.base_level);
  const double posts = static_cast<double>(info.posts_per_tile) * info.posts_per_tile;
  const double tile_bytes = posts * 4.4 + 16384;
  const double count = static_cast<double>(tiles.width()) * static_cast<double>(tiles.height()) * 1.5 + 64;
  return (static_cast<std::size_t>(count * tile_bytes * 2) + (std::size_t{64} << 20)) & ~std::size_t{0xFFFF};
}

Result<void> check_options(const IngestOptions& options) {
  if (auto ok = check_name("layer", options.layer); !ok) return ok;
  for (const int posts : {65, 129, 257, 513, 1025}) {
    if (options.posts_per_tile == posts) return {};
  }
  return Error{ErrorCode::kInvalidArgument, "posts per tile must be 65, 129, 257, 513 or 1025, not " +
                                                std::to_string(options.posts_per_tile)};
}

}  // namespace

Result<LayerInfo> ingest(const fs::path& data_dir, const IngestOptions& options, const IngestKernels& kernels,
                         const std::function<void(const IngestProgress&)>& progress) {
  if (auto ok = check_options(options); !ok) return ok.error();
  auto plan = plan_rasters(options);
  if (!plan) return std::move(plan.error()).within("ingesting layer " + options.layer);
  const fs::path directory = layer_directory(data_dir, options.layer);
  std::error_code ec;
  fs::create_directories(directory, ec);
  if (ec) return Error{ErrorCode::kIo, directory.string() + " cannot be made: " + ec.message()};
  auto lock = FileLock::acquire(directory / "lock", "layer " + options.layer);
  if (!lock) return lock.error();
  std::string current;
  std::optional<LayerInfo> previous;
  if (auto old = LayerStore::open(data_dir, options.layer)) previous = (*old)->info();
  if (auto generation = current_generation(data_dir, options.layer))
    current = generation->filename().string();
  char name[32];
  std::snprintf(name, sizeof name, "gen-%06lld", static_cast<long long>(sweep(directory, current) + 1));
  const fs::path building = directory / (std::string(name) + ".building");

  auto info = [&]() -> Result<LayerInfo> {
    auto env = LmdbEnv::open(building, LmdbEnv::Mode::kBuild, map_bytes_for(plan->info));
    if (!env) return env.error();
    return Ingest(options, kernels, std::move(*plan), *env, progress).run();
  }();
  if (info) {
    fs::remove(building / "lock.mdb", ec);
    const auto publish = [&]() -> Result<void> {
      if (auto ok = sync_directory(building); !ok) return ok;
      fs::rename(building, directory / name, ec);
      if (ec) return Error{ErrorCode::kIo, building.string() + " cannot be renamed: " + ec.message()};
      if (auto ok = sync_directory(directory); !ok) return ok;
      return replace_file(directory / "CURRENT", std::string(name) + "\n");
    };
    if (auto ok = publish(); !ok) info = ok.error();
  }
  if (!info) {
    sweep(directory, current);
    return std::move(info.error()).within("ingesting layer " + options.layer);
  }
  sweep(directory, name);  // the old generation; whoever has it open keeps its map
  if (auto ok = rewarp_masks(data_dir, *info, previous ? &*previous : nullptr); !ok) {
    return std::move(ok.error())
        .within("warping the masks of layer " + options.layer + ", which is ingested");
  }
  if (progress) progress({"publish", 1});
  return info;
}

}  // namespace lodestone
