#include "service/ground/roughness_models.h"

#include <fmt/format.h>

#include <algorithm>
#include <atomic>
#include <bit>
#include <nlohmann/json.hpp>
#include <mutex>
#include <optional>
#include <thread>

namespace lodestone {
namespace {

using nlohmann::json;

constexpr int kBlockEntries = 128;  // map entries per edge of one piece of work

std::uint32_t bits(float value) { return std::bit_cast<std::uint32_t>(value); }

}  // namespace

std::vector<LsaParameters> default_lsa_parameters() {
  std::vector<LsaParameters> all;
  for (const int window : {1, 3, 5, 7}) {
    LsaParameters parameters;
    parameters.window = window;
    all.push_back(parameters);
  }
  return all;
}

Result<std::vector<AnalysisStep>> analysis_steps(const LayerStore& layer, const PostWindow& entries,
                                                 const LsaParameters& parameters) {
  const LayerInfo& info = layer.info();
  const std::vector<PostWindow> needs = lsa_needs(entries, info.world, parameters);
  std::vector<AnalysisStep> steps;
  for (std::size_t l = 0; l < needs.size(); ++l) {
    const int level = info.base_level - static_cast<int>(l);
    if (level < 0) break;
    const PostWindow world = info.world_at(level);
    auto fine = layer.read_window(level, analysis_window(needs[l], world));
    if (!fine) return fine.error();
    steps.push_back(analyse(*fine, world, needs[l]));
  }
  return steps;
}

Result<std::vector<RoughnessModel>> compute_models(const LayerStore& layer, std::span<const LsaParameters> parameters,
                                                   int threads, const std::function<void(double)>& progress) {
  const LayerInfo& info = layer.info();
  std::vector<RoughnessModel> models;
  LsaParameters widest;
  widest.levels = 1;
  widest.window = 1;
  for (const LsaParameters& p : parameters) {
    RoughnessModel model;
    model.parameters = p;
    model.fits = fit_layer(info.variances, p.fit);
    models.push_back(model);
    widest.window = std::max(widest.window, p.window);
    widest.levels = std::max(widest.levels, p.levels);
  }
  // Blocks of the largest band, worked on in any order, added up in theirs.
  std::int64_t width = 0;
  std::int64_t height = 0;
  for (int band = 0; band < 3; ++band) {
    const auto size = sigma_map_size(info.world, band);
    width = std::max(width, size[0]);
    height = std::max(height, size[1]);
  }
  const std::int64_t blocks_x = (width + kBlockEntries - 1) / kBlockEntries;
  const std::int64_t blocks_y = (height + kBlockEntries - 1) / kBlockEntries;
  const std::int64_t block_count = blocks_x * blocks_y;
  std::vector<LsaEnergy> energies(static_cast<std::size_t>(block_count) * models.size());
  std::atomic<std::int64_t> next{0};
  std::mutex mutex;
  std::optional<Error> failure;
  const auto work = [&] {
    for (std::int64_t block = next++; block < block_count; block = next++) {
      const std::int64_t i0 = block % blocks_x * kBlockEntries;
      const std::int64_t j0 = block / blocks_x * kBlockEntries;
      const PostWindow entries{i0, j0, std::min(i0 + kBlockEntries, width) - 1, std::min(j0 + kBlockEntries, height) - 1};
      auto steps = analysis_steps(layer, entries, widest);
      if (!steps) {
        const std::lock_guard lock(mutex);
        if (!failure) failure = steps.error();
        return;
      }
      for (std::size_t m = 0; m < models.size(); ++m) {
        const auto maps = lsa_maps(entries, info.world, *steps, models[m].fits, models[m].parameters);
        energies[static_cast<std::size_t>(block) * models.size() + m] = lsa_energy(maps);
      }
      if (progress) {
        const std::lock_guard lock(mutex);
        progress(static_cast<double>(block + 1) / static_cast<double>(block_count));
      }
    }
  };
  std::vector<std::thread> pool;
  for (int n = 1; n < threads; ++n) pool.emplace_back(work);
  work();
  for (std::thread& thread : pool) thread.join();
  if (failure) return std::move(*failure).within("computing the roughness maps of layer " + info.name);

  for (std::size_t m = 0; m < models.size(); ++m) {
    LsaEnergy total;
    for (std::int64_t block = 0; block < block_count; ++block) {
      const LsaEnergy& part = energies[static_cast<std::size_t>(block) * models.size() + m];
      for (int band = 0; band < 3; ++band) {
        total.count[band] += part.count[band];
        for (int s = 0; s < kMaxDepth; ++s) total.sum[band][s] += part.sum[band][s];
      }
    }
    models[m].bands = band_sigmas(models[m].fits, &total, models[m].parameters.match_energy);
  }
  return models;
}

std::string models_json(std::span<const RoughnessModel> models) {
  json all = json::array();
  for (const RoughnessModel& model : models) {
    json bands = json::array();
    for (int band = 0; band < 3; ++band) {
      const BandFit& fit = model.fits[band];
      json kappa = json::array();
      for (const float k : model.bands[band].kappa) kappa.push_back(bits(k));
      bands.push_back({{"a", std::bit_cast<std::uint64_t>(fit.a)},
                       {"gamma", std::bit_cast<std::uint64_t>(fit.gamma)},
                       {"flat", fit.is_flat},
                       {"clamped", fit.is_clamped},
                       {"levels_used", fit.levels_used},
                       {"s0", bits(fit.s0)},
                       {"q", bits(fit.q)},
                       {"kappa", kappa},
                       {"text", fmt::format("A {:.6f} gamma {:.6f} H {:.4f}", fit.a, fit.gamma, fit.gamma / 2)}});
    }
    const LsaParameters& p = model.parameters;
    all.push_back({{"window", p.window},
                   {"levels", p.levels},
                   {"trust", p.trust},
                   {"energy", p.match_energy ? "match" : "free"},
                   {"fit", p.fit == FitWeights::kPaper ? "paper" : "weighted"},
                   {"bands", bands}});
  }
  return all.dump();
}

Result<std::vector<RoughnessModel>> models_from_json(const std::string& text) {
  std::vector<RoughnessModel> models;
  try {
    for (const json& item : json::parse(text)) {
      RoughnessModel model;
      model.parameters.window = item.at("window");
      model.parameters.levels = item.at("levels");
      model.parameters.trust = item.at("trust");
      model.parameters.match_energy = item.at("energy") == "match";
      model.parameters.fit = item.at("fit") == "paper" ? FitWeights::kPaper : FitWeights::kWeighted;
      for (int band = 0; band < 3; ++band) {
        const json& b = item.at("bands").at(band);
        BandFit& fit = model.fits[band];
        fit.a = std::bit_cast<double>(b.at("a").get<std::uint64_t>());
        fit.gamma = std::bit_cast<double>(b.at("gamma").get<std::uint64_t>());
        fit.is_flat = b.at("flat");
        fit.is_clamped = b.at("clamped");
        fit.levels_used = b.at("levels_used");
        fit.s0 = std::bit_cast<float>(b.at("s0").get<std::uint32_t>());
        fit.q = std::bit_cast<float>(b.at("q").get<std::uint32_t>());
        model.bands[band].s0 = fit.s0;
        model.bands[band].q = fit.q;
        for (int s = 0; s < kMaxDepth; ++s) {
          model.bands[band].kappa[s] = std::bit_cast<float>(b.at("kappa").at(s).get<std::uint32_t>());
        }
      }
      models.push_back(model);
    }
  } catch (const json::exception& error) {
    return Error{ErrorCode::kCorrupt, std::string("stored roughness models: ") + error.what() + "; ingest the layer again"};
  }
  return models;
}

}  // namespace lodestone
