#pragma once
// Layers for tests: the packaged sample always, real DEMs beside the checkout where they are present.

#include <gtest/gtest.h>

#include <filesystem>
#include <iostream>
#include <string>
#include <unistd.h>
#include <vector>

#include "kernels/synthesis/roughness.h"
#include "service/ground/layer.h"
#include "service/ground/roughness_models.h"
#include "storage/dem/ingest.h"

namespace lodestone::test {

struct SampleLayer {
  std::string name;
  std::vector<std::string> sources;
};

// Jacksboro, and of the data beside the checkout what is there; says which.
inline const std::vector<SampleLayer>& sample_layers() {
  static const std::vector<SampleLayer> layers = [] {
  std::vector<SampleLayer> all = {{"jacksboro", {LODESTONE_SOURCE_DIR "/config/jacksboro.vrt"}}};
  const std::filesystem::path data = LODESTONE_SHARED_DATA;
  const std::vector<SampleLayer> optional = {
      {"bigtujunga", {data / "bigtujunga/bigtujunga_30m.tif"}},
      {"andorra", {data / "andorra/N42E001.hgt", data / "andorra/N41E001.hgt"}},
      {"rainier", {data / "rainier/N46W122_srtm3.tif"}},
      {"meghalaya", {data / "awkward/meghalaya_50m_int16_nonsquare.tif"}},
      {"rotated", {data / "awkward/bigtujunga_rotated.tif"}},
      {"mongon", {data / "awkward/mongon_multiband_nan.tif"}},
  };
  for (const SampleLayer& layer : optional) {
    const bool is_there = std::all_of(layer.sources.begin(), layer.sources.end(), [](const std::string& s) { return std::filesystem::exists(s); });
    std::cout << "[ data     ] " << layer.name << (is_there ? " used" : " not present, left out") << "\n";
    if (is_there) all.push_back(layer);
  }
  return all;
  }();
  return layers;
}

inline IngestKernels ingest_kernels() {
  IngestKernels kernels;
  kernels.analysis_window = analysis_window;
  kernels.analyse = analyse;
  kernels.finish = [](const LayerStore& layer) -> Result<std::string> {
    const auto parameters = default_lsa_parameters();
    auto models = compute_models(layer, parameters, 2);
    if (!models) return models.error();
    return models_json(*models);
  };
  return kernels;
}

// A data directory that is removed at the end.
class DataDir {
 public:
  DataDir() : path_(std::filesystem::path(::testing::TempDir()) / ("lodestone-test-" + std::to_string(::getpid()))) {
    std::filesystem::create_directories(path_);
  }
  ~DataDir() {
    std::error_code ignored;
    std::filesystem::remove_all(path_, ignored);
  }
  const std::filesystem::path& path() const { return path_; }

  std::shared_ptr<const Layer> ingest_and_open(const SampleLayer& sample) const {
    IngestOptions options;
    options.sources = sample.sources;
    options.layer = sample.name;
    auto info = ingest(path_, options, ingest_kernels(), {});
    if (!info) {
      ADD_FAILURE() << info.error().message;
      return nullptr;
    }
    auto layer = Layer::open(path_, sample.name, std::size_t{64} << 20, std::size_t{64} << 20);
    if (!layer) {
      ADD_FAILURE() << layer.error().message;
      return nullptr;
    }
    return *layer;
  }

 private:
  const std::filesystem::path path_;
};

}  // namespace lodestone::test
