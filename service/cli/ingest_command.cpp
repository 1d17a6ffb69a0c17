// lodestone ingest

#include <fmt/format.h>

#include <CLI/CLI.hpp>
#include <nlohmann/json.hpp>

#include "kernels/synthesis/roughness.h"
#include "service/app/app.h"
#include "service/cli/commands.h"
#include "service/cli/progress.h"
#include "service/ground/roughness_models.h"
#include "storage/dem/ingest.h"

namespace lodestone {
namespace {

struct Flags {
  IngestOptions ingest;
  std::string grid = "native";
  std::string nodata;
  bool is_json = false;
};

int run(const Flags& flags, const CommonFlags& common) {
  auto options = common.load();
  if (!options) return fail(options.error());
  IngestOptions ingest_options = flags.ingest;
  auto grid = grid_kind_from(flags.grid);
  if (!grid) return fail(grid.error());
  ingest_options.grid = *grid;
  ingest_options.threads = worker_count(*options);
  if (!flags.nodata.empty()) {
    char* end = nullptr;
    ingest_options.nodata = std::strtod(flags.nodata.c_str(), &end);
    if (*end != '\0') return fail({ErrorCode::kInvalidArgument, "--nodata " + flags.nodata + ": must be a number or nan"});
  }
  IngestKernels kernels;
  kernels.analysis_window = analysis_window;
  kernels.analyse = analyse;
  kernels.finish = [&](const LayerStore& layer) -> Result<std::string> {
    const auto parameters = default_lsa_parameters();
    auto models = compute_models(layer, parameters, ingest_options.threads);
    if (!models) return models.error();
    return models_json(*models);
  };
  ProgressBar bar(flags.is_json);
  auto info = ingest(options->data_dir, ingest_options, kernels,
                     [&](const IngestProgress& progress) { bar.show(progress.phase, progress.fraction); });
  bar.done();
  if (!info) return fail(info.error());
  if (flags.is_json) {
    fmt::print("{}\n", layer_info_json(*info));
  } else {
    fmt::print("layer {}: {} x {} posts, base level {}, {:.1f} to {:.1f} m, {} void posts, {}\n", info->name, info->world.width(),
               info->world.height(), info->base_level, info->height_min_m, info->height_max_m, info->void_posts, info->crs_name);
  }
  return kDone;
}

}  // namespace

Run declare_ingest(CLI::App& command, CommonFlags& common) {
  auto flags = std::make_shared<Flags>();
  command.add_option("SRC", flags->ingest.sources, "Rasters; where they overlap, the one named first wins")->required();
  command.add_option("--layer", flags->ingest.layer, "Name of the layer")->required();
  command.add_option("--grid", flags->grid, "native, WorldCRS84Quad or WebMercatorQuad")->capture_default_str();
  command.add_option("--band", flags->ingest.band, "Band with the heights, from 1")->capture_default_str();
  command.add_option("--nodata", flags->nodata, "Value that means no data, instead of the file's tag");
  command.add_option("--datum", flags->ingest.datum, "Vertical datum, for the layer's description");
  command.add_option("--unit", flags->ingest.unit, "Vertical unit: m, ft or us-ft, instead of the file's");
  command.add_option("--posts-per-tile", flags->ingest.posts_per_tile, "65, 129, 257, 513 or 1025")->capture_default_str();
  command.add_flag("--json", flags->is_json, "Print the layer's description as JSON");
  return [flags, &common] { return run(*flags, common); };
}

}  // namespace lodestone
