// lodestone inspect, verify, purge, devices, config: what operators ask of a data directory and of a machine.

#include <fmt/format.h>

#include <CLI/CLI.hpp>
#include <nlohmann/json.hpp>

#include "kernels/device/device.h"
#include "service/app/app.h"
#include "service/cli/commands.h"
#include "service/cli/progress.h"
#include "storage/cache/disk_cache.h"

namespace lodestone {
namespace {

using nlohmann::ordered_json;
namespace fs = std::filesystem;

int run_inspect(const CommonFlags& common, const std::string& only, bool is_json) {
  auto options = common.load();
  if (!options) return fail(options.error());
  std::vector<std::string> names = list_layers(options->data_dir);
  if (!only.empty()) names = {only};
  ordered_json all = ordered_json::array();
  for (const std::string& name : names) {
    auto layer = Layer::open(options->data_dir, name, std::size_t{16} << 20, std::size_t{1} << 20);
    if (!layer) return fail(layer.error());
    const LayerInfo& info = (*layer)->info();
    ordered_json json = ordered_json::parse(layer_info_json(info));
    json["revision"] = (*layer)->revision();
    json["masks"] = ordered_json::array();
    for (const MaskInfo& mask : (*layer)->mask_list()) json["masks"].push_back(mask.name);
    auto model = (*layer)->model(LsaParameters{});
    if (!model) return fail(model.error());
    json["roughness"] = ordered_json::array();
    for (const BandFit& fit : (*model)->fits) {
      json["roughness"].push_back({{"a", fit.a}, {"gamma", fit.gamma}, {"hurst", fit.gamma / 2}, {"flat", fit.is_flat}, {"clamped", fit.is_clamped}, {"levels_used", fit.levels_used}});
    }
    if (is_json) {
      all.push_back(json);
      continue;
    }
    fmt::print("{}\n  revision {}\n  crs {}, grid {}, datum {}\n  {} x {} posts of {:.2f} x {:.2f} m, tiles of {} posts\n  base level {}, synthetic to {}\n"
               "  heights {:.2f} to {:.2f} m, {} void posts\n  bounds {:.6f} {:.6f} {:.6f} {:.6f} (WGS84)\n",
               name, (*layer)->revision(), info.crs_name, to_string(info.grid), info.datum, info.world.width(), info.world.height(),
               info.cell_x_m, info.cell_y_m, info.posts_per_tile, info.base_level, info.max_level(), info.height_min_m, info.height_max_m,
               info.void_posts, info.bounds_wgs84[0], info.bounds_wgs84[1], info.bounds_wgs84[2], info.bounds_wgs84[3]);
    for (const std::string& source : info.sources) fmt::print("  source {}\n", source);
    static constexpr std::string_view bands[] = {"horizontal", "vertical", "diagonal"};
    for (int band = 0; band < 3; ++band) {
      const BandFit& fit = (*model)->fits[band];
      fmt::print("  roughness {:<10} sigma {:.4f} m at the first new level, Hurst {:.3f}{}{}\n", bands[band], fit.s0, fit.gamma / 2,
                 fit.is_flat ? ", flat" : "", fit.is_clamped ? ", clamped" : "");
    }
    for (const MaskInfo& mask : (*layer)->mask_list()) fmt::print("  mask {} ({} x {}, mean {:.4f})\n", mask.name, mask.width, mask.height, mask.mean);
  }
  if (is_json) fmt::print("{}\n", all.dump(1, ' ', false, ordered_json::error_handler_t::replace));
  if (names.empty() && !is_json) fmt::print("no layers in {}; `lodestone ingest FILE --layer NAME` makes one\n", options->data_dir);
  return kDone;
}

int run_verify(const CommonFlags& common, const std::string& only, bool repair, bool is_json) {
  auto options = common.load();
  if (!options) return fail(options.error());
  std::vector<std::string> names = list_layers(options->data_dir);
  if (!only.empty()) names = {only};
  ordered_json report = ordered_json::object();
  std::size_t problem_count = 0;
  ProgressBar bar(is_json);
  for (const std::string& name : names) {
    auto layer = verify_layer(options->data_dir, name, [&](double fraction) { bar.show("layer " + name, fraction); });
    if (!layer) return fail(layer.error());
    problem_count += layer->problems.size();
    report["layers"][name] = {{"values", layer->values}, {"bytes", layer->bytes}, {"problems", layer->problems}};
    if (is_json) continue;
    fmt::print("layer {}: {} values, {} bytes, {} problems\n", name, layer->values, layer->bytes, layer->problems.size());
    for (const std::string& problem : layer->problems) fmt::print("  {}\n", problem);
  }
  bar.done();
  const fs::path cache = fs::path(options->data_dir) / "cache";
  if (only.empty() && fs::exists(cache)) {
    if (repair) {
      auto lock = FileLock::acquire(fs::path(options->data_dir) / "lock", "data directory " + options->data_dir);
      if (!lock) return fail(lock.error());
    }
    auto disk = verify_disk_cache(cache, repair);
    if (disk) {
      problem_count += disk->corrupt;
      report["cache"] = {{"entries", disk->entries}, {"bytes", disk->bytes}, {"corrupt", disk->corrupt}};
      if (!is_json) fmt::print("cache: {} entries, {} bytes, {} corrupt{}\n", disk->entries, disk->bytes, disk->corrupt, repair ? " (removed)" : "");
    } else if (disk.error().code != ErrorCode::kNotFound) {
      ++problem_count;
      report["cache"] = {{"error", disk.error().message}};
      if (!is_json) fmt::print("cache: {}\n", disk.error().message);
    }
  }
  if (is_json) fmt::print("{}\n", report.dump(1, ' ', false, ordered_json::error_handler_t::replace));
  return problem_count == 0 ? kDone : kDoneWithFailures;
}

int run_purge(const CommonFlags& common, const std::string& tag) {
  auto options = common.load();
  if (!options) return fail(options.error());
  auto lock = FileLock::acquire(fs::path(options->data_dir) / "lock", "data directory " + options->data_dir);
  if (!lock) return fail({lock.error().code, lock.error().message + "; a running daemon purges by POST /purge on its admin listener"});
  DiskCacheOptions disk;
  disk.directory = fs::path(options->data_dir) / "cache";
  disk.budget_bytes = static_cast<std::uint64_t>(options->disk_cache_mib) << 20;
  disk.kernel_hash = kernel_source_hash();
  const auto cache = DiskCache::open(disk);
  auto removed = cache->purge(tag);
  if (!removed) return fail(removed.error());
  fmt::print("removed {} cached tiles\n", *removed);
  return kDone;
}

int run_devices(const CommonFlags& common, bool is_json) {
  auto options = common.load();
  if (!options) return fail(options.error());
  prepare_pocl_environment((fs::temp_directory_path() / "lodestone-pocl").string());
  const auto devices = list_devices();
  ordered_json all = ordered_json::array();
  for (const DeviceDescription& d : devices) {
    if (is_json) {
      all.push_back({{"platform", d.platform}, {"name", d.name}, {"vendor", d.vendor}, {"version", d.version}, {"driver", d.driver}, {"type", d.type},
                     {"compute_units", d.compute_units}, {"global_bytes", d.global_bytes}, {"max_work_group", d.max_work_group}});
    } else {
      fmt::print("{} / {}\n  {}, {} compute units, {} MiB, driver {}, {}\n", d.platform, d.name, d.type, d.compute_units, d.global_bytes >> 20, d.driver, d.version);
    }
  }
  if (is_json) fmt::print("{}\n", all.dump(1, ' ', false, ordered_json::error_handler_t::replace));
  if (devices.empty() && !is_json) fmt::print("no OpenCL device; install pocl-opencl-icd, or set device = \"host\" to compute in plain C++\n");
  return devices.empty() ? kFailed : kDone;
}

}  // namespace

Run declare_inspect(CLI::App& command, CommonFlags& common) {
  auto layer = std::make_shared<std::string>();
  auto is_json = std::make_shared<bool>(false);
  command.add_option("LAYER", *layer, "Only this layer");
  command.add_flag("--json", *is_json, "JSON instead of text");
  return [=, &common] { return run_inspect(common, *layer, *is_json); };
}

Run declare_verify(CLI::App& command, CommonFlags& common) {
  auto layer = std::make_shared<std::string>();
  auto is_json = std::make_shared<bool>(false);
  auto repair = std::make_shared<bool>(false);
  command.add_option("LAYER", *layer, "Only this layer; without it all layers and the tile cache");
  command.add_flag("--repair", *repair, "Remove corrupt cache entries (they are made again when asked for)");
  command.add_flag("--json", *is_json, "JSON instead of text");
  return [=, &common] { return run_verify(common, *layer, *repair, *is_json); };
}

Run declare_purge(CLI::App& command, CommonFlags& common) {
  auto layer = std::make_shared<std::string>();
  auto recipe = std::make_shared<std::string>();
  command.add_option("LAYER", *layer, "Only tiles of this layer");
  command.add_option("RECIPE", *recipe, "Only tiles of this recipe of the layer");
  return [=, &common] { return run_purge(common, recipe->empty() ? *layer : *layer + "/" + *recipe); };
}

Run declare_devices(CLI::App& command, CommonFlags& common) {
  auto is_json = std::make_shared<bool>(false);
  command.add_flag("--json", *is_json, "JSON instead of text");
  return [=, &common] { return run_devices(common, *is_json); };
}

Run declare_config(CLI::App& command, CommonFlags& common) {
  auto action = std::make_shared<std::string>();
  auto comments = std::make_shared<bool>(false);
  command.add_option("ACTION", *action, "check: say whether the configuration is valid; dump: print it as it is in force")
      ->required()
      ->check(CLI::IsMember({"check", "dump"}));
  command.add_flag("--comments", *comments, "dump: with the meaning of every option");
  return [=, &common] {
    auto options = common.load();
    if (!options) {
      fmt::print(stderr, "lodestone: {}\n", options.error().message);
      return kFailed;
    }
    if (*action == "dump") {
      fmt::print("{}", dump_options(*options, *comments));
    } else {
      fmt::print("configuration is valid: {} recipes\n", options->recipes.size());
    }
    return kDone;
  };
}

}  // namespace lodestone
