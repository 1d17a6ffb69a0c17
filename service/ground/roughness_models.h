#pragma once
// RoughnessModel: what GSA and LSA need to know of a layer for one set of parameters. Computed at ingest for the default
// parameters, stored with the layer, and computed on demand for others.

#include <array>
#include <functional>
#include <span>
#include <string>
#include <vector>

#include "kernels/synthesis/roughness.h"
#include "kernels/types/result.h"
#include "storage/dem/layer_store.h"

namespace lodestone {

struct RoughnessModel {
  LsaParameters parameters;
  std::array<BandFit, 3> fits;     // GSA
  std::array<BandSigma, 3> bands;  // s0, q of the fit; kappa for LSA
};

// Windows 1, 3, 5, 7 with the default parameters.
std::vector<LsaParameters> default_lsa_parameters();

// One pass over the base level for all of `parameters`. Same result for any number of threads. Errors: those of read_window.
Result<std::vector<RoughnessModel>> compute_models(const LayerStore& layer, std::span<const LsaParameters> parameters,
                                                   int threads, const std::function<void(double)>& progress = {});

// JSON of models (floats as their exact bits), and back. Error: kCorrupt.
std::string models_json(std::span<const RoughnessModel> models);
Result<std::vector<RoughnessModel>> models_from_json(const std::string& text);

// Analysis steps over `entries` of the LSA maps, for every detail level that `parameters` (the largest of a set) needs.
Result<std::vector<AnalysisStep>> analysis_steps(const LayerStore& layer, const PostWindow& entries,
                                                 const LsaParameters& parameters);

}  // namespace lodestone
