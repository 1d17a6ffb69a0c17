// lodestone evaluate: hides the finest real levels of a layer, makes them again, and compares. SPEC-SYNTHESIS section 9.

#include <fmt/format.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <fstream>
#include <nlohmann/json.hpp>

#include "kernels/synthesis/evaluate.h"
#include "service/app/app.h"
#include "service/cli/commands.h"
#include "service/ground/ground_maker.h"
#include "service/ground/held_out_store.h"
#include "storage/formats/raster_tile.h"

namespace lodestone {
namespace {

// Larger layers are compared on their middle.
constexpr std::int64_t kMostPostsPerEdge = 4096;
constexpr int kPicturePosts = 256;

struct Flags {
  std::string layer, output;
  int levels = 2;
  std::uint64_t seed = 1;
  std::vector<std::string> recipes = {"linear", "gsa", "lsa"};
  bool is_json = false;
};

// The recipe's heights over `window` (global indices of level z), from whole tiles.
Result<HeightGrid> synthesise(GroundMaker& maker, const std::shared_ptr<const Layer>& layer, const Recipe& recipe, std::uint64_t seed, int z,
                              const PostWindow& window) {
  HeightGrid out{window, std::vector<float>(static_cast<std::size_t>(window.width() * window.height())), {}};
  const LayerInfo& info = layer->info();
  const PostWindow tiles = info.tiles_at(z);
  for (std::int64_t y = tiles.j0; y <= tiles.j1; ++y) {
    for (std::int64_t x = tiles.i0; x <= tiles.i1; ++x) {
      const GroundRequest request{layer, recipe, seed, {z, x, y}};
      const PostWindow tile = info.tile_window(request.id);
      const std::int64_t i0 = std::max(tile.i0, window.i0);
      const std::int64_t i1 = std::min(tile.i1, window.i1);
      if (i0 > i1 || tile.j1 < window.j0 || tile.j0 > window.j1) continue;
      const auto grounds = maker.make(std::span(&request, 1));
      if (!grounds[0]) return grounds[0].error();
      for (std::int64_t j = std::max(tile.j0, window.j0); j <= std::min(tile.j1, window.j1); ++j) {
        const float* from = &grounds[0]->heights_m[static_cast<std::size_t>((j - tile.j0) * tile.width() + i0 - tile.i0)];
        std::copy_n(from, i1 - i0 + 1, &out.heights_m[out.index(i0, j)]);
      }
    }
  }
  return out;
}

// Up to four hillshades in a square: north-west, north-east, south-west, south-east.
Result<void> write_picture(const std::string& path, const std::vector<const HeightGrid*>& grids, const LayerInfo& info) {
  const PostWindow& window = grids[0]->window;
  const int n = static_cast<int>(std::min<std::int64_t>({kPicturePosts, window.width(), window.height()}));
  const int edge = 2 * n;
  std::vector<float> mosaic(static_cast<std::size_t>(edge) * edge, 0.0F);
  const std::int64_t i0 = window.i0 + (window.width() - n) / 2;
  const std::int64_t j0 = window.j0 + (window.height() - n) / 2;
  for (std::size_t k = 0; k < grids.size() && k < 4; ++k) {
    for (int row = 0; row < n; ++row) {
      float* to = &mosaic[(static_cast<std::size_t>(row) + k / 2 * n) * edge + k % 2 * n];
      std::copy_n(&grids[k]->heights_m[grids[k]->index(i0, j0 + row)], n, to);
    }
  }
  auto png = encode_png_tile(mosaic, edge, 0, PngEncoding::kHillshade, edge, info.cell_x_m, info.cell_y_m);
  if (!png) return png.error();
  std::ofstream file(path, std::ios::binary);
  file.write(png->data(), static_cast<std::streamsize>(png->size()));
  if (!file.flush()) return Error{ErrorCode::kIo, "cannot write " + path};
  return {};
}

nlohmann::ordered_json metrics_json(const std::string& recipe, int k, const HoldOutMetrics& m) {
  return {{"recipe", recipe}, {"levels", k}, {"band_rms", m.band_rms}, {"rough_corr", m.rough_corr}, {"slope_real", m.slope_real},
          {"slope_synthetic", m.slope_synthetic}, {"kurtosis_real", m.kurtosis_real}, {"kurtosis_synthetic", m.kurtosis_synthetic},
          {"log2_variance_ratio", m.log2_variance_ratio}};
}

int run(const Flags& flags, const CommonFlags& common) {
  auto options = common.load();
  if (!options) return fail(options.error());
  auto store = LayerStore::open(options->data_dir, flags.layer);
  if (!store) return fail(store.error());
  const LayerInfo& info = (*store)->info();
  if (flags.levels < 1 || flags.levels > info.base_level) {
    return fail({ErrorCode::kInvalidArgument, fmt::format("--levels {}: layer {} has {} levels below its base; give 1..{}", flags.levels, flags.layer, info.base_level, info.base_level)});
  }
  for (const std::string& name : flags.recipes) {
    if (options->recipes.count(name) == 0) return fail({ErrorCode::kNotFound, "no recipe \"" + name + "\""});
  }
  auto device = open_device(*options);
  if (!device) return fail(device.error());
  auto maker = GroundMaker::create(*device);
  if (!maker) return fail(maker.error());
  if (!flags.output.empty()) std::filesystem::create_directories(flags.output);

  nlohmann::ordered_json report = nlohmann::ordered_json::array();
  if (!flags.is_json) {
    fmt::print("{:<16} {:>6} {:>9} {:>10} {:>10} {:>10} {:>9} {:>9}  log2(V_syn/V_real) per level, finest first: d1 d2 d3\n", "recipe", "levels",
               "band_rms", "rough_corr", "slope_real", "slope_syn", "kurt_real", "kurt_syn");
  }
  for (int k = 1; k <= flags.levels; ++k) {
    auto layer = Layer::over(std::make_shared<HeldOutStore>(*store, k), std::size_t{64} << 20);
    if (!layer) return fail(layer.error());
    PostWindow window = finer((*layer)->info().world, k);
    for (auto [first, last] : {std::pair(&window.i0, &window.i1), std::pair(&window.j0, &window.j1)}) {
      if (*last - *first < kMostPostsPerEdge) continue;
      *first += (*last - *first - kMostPostsPerEdge) / 2;
      *last = *first + kMostPostsPerEdge - 1;
    }
    auto real = (*store)->read_window(info.base_level, window);
    if (!real) return fail(real.error());
    std::vector<HeightGrid> made;
    for (const std::string& name : flags.recipes) {
      auto grid = synthesise(**maker, *layer, options->recipes.at(name), flags.seed, (*layer)->info().base_level + k, window);
      if (!grid) return fail(grid.error());
      const HoldOutMetrics m = compare_levels(*real, *grid, k);
      made.push_back(std::move(*grid));
      report.push_back(metrics_json(name, k, m));
      if (flags.is_json) continue;
      fmt::print("{:<16} {:>6} {:>9.3f} {:>10.3f} {:>10.3f} {:>10.3f} {:>9.2f} {:>9.2f} ", name, k, m.band_rms, m.rough_corr, m.slope_real, m.slope_synthetic,
                 m.kurtosis_real, m.kurtosis_synthetic);
      for (const auto& level : m.log2_variance_ratio) fmt::print(" [{:.2f} {:.2f} {:.2f}]", level[0], level[1], level[2]);
      fmt::print("\n");
    }
    if (!flags.output.empty()) {
      std::vector<const HeightGrid*> grids{&*real};
      for (const HeightGrid& grid : made) grids.push_back(&grid);
      const std::string path = fmt::format("{}/{}-{}.png", flags.output, flags.layer, k);
      if (auto ok = write_picture(path, grids, info); !ok) return fail(ok.error());
      if (!flags.is_json) fmt::print("{}: original, {}\n", path, fmt::join(flags.recipes, ", "));
    }
  }
  if (flags.is_json) fmt::print("{}\n", report.dump(1));
  return kDone;
}

}  // namespace

Run declare_evaluate(CLI::App& command, CommonFlags& common) {
  auto flags = std::make_shared<Flags>();
  command.add_option("LAYER", flags->layer, "Name of the layer")->required();
  command.add_option("--levels", flags->levels, "Hide the finest 1..N real levels")->capture_default_str();
  command.add_option("--seed", flags->seed, "Seed of the synthesis")->capture_default_str();
  command.add_option("--recipes", flags->recipes, "Recipes to compare")->delimiter(',')->capture_default_str();
  command.add_option("-o,--output", flags->output, "Folder for hillshade pictures: original and three recipes in a square");
  command.add_flag("--json", flags->is_json, "JSON instead of a table");
  return [flags, &common] { return run(*flags, common); };
}

}  // namespace lodestone
