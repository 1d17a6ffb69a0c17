#pragma once
// Rasters and layers for the storage tests: GeoTIFFs written by GDAL, a scratch folder, the real analysis
// kernels.

#include <gdal_priv.h>
#include <ogr_spatialref.h>
#include <unistd.h>

#include <array>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <limits>
#include <optional>
#include <string>
#include <vector>

#include "kernels/synthesis/roughness.h"
#include "storage/dem/ingest.h"

namespace lodestone::testing {

// A folder of its own, removed at the end.
class Scratch {
 public:
  Scratch() {
    std::string name = (std::filesystem::temp_directory_path() / "lodestone-XXXXXX").string();
    path_ = ::mkdtemp(name.data());
  }
  ~Scratch() {
    std::error_code ignored;
    std::filesystem::remove_all(path_, ignored);
  }
  Scratch(const Scratch&) = delete;
  Scratch& operator=(const Scratch&) = delete;
  const std::filesystem::path& path() const { return path_; }
  std::string operator/(const std::string& name) const { return (path_ / name).string(); }

 private:
  std::filesystem::path path_;
};

struct RasterSpec {
  int width = 0, height = 0, bands = 1;
  std::array<double, 6> transform{500000, 30, 0, 4000000, 0, -30};  // GDAL's: corner of the north-west pixel
  std::string crs = "EPSG:32617";                                   // empty: none
  GDALDataType type = GDT_Float32;
  std::optional<double> nodata;
  std::optional<double> scale, offset;
  std::string unit;
  std::vector<std::string> options;  // of the driver
  std::string driver = "GTiff";
  bool has_transform = true;
  bool is_palette = false;
};

// Band b, column i, row j gets value(i, j, b); nothing is written when `value` is empty.
inline void write_raster(const std::string& path, const RasterSpec& spec,
                         const std::function<double(int, int, int)>& value) {
  GDALAllRegister();
  char** options = nullptr;
  for (const std::string& o : spec.options) options = CSLAddString(options, o.c_str());
  GDALDriver* driver = GetGDALDriverManager()->GetDriverByName(spec.driver.c_str());
  GDALDataset* d = driver->Create(path.c_str(), spec.width, spec.height, spec.bands, spec.type, options);
  CSLDestroy(options);
  if (d == nullptr) return;
  auto transform = spec.transform;
  if (spec.has_transform) d->SetGeoTransform(transform.data());
  if (!spec.crs.empty()) {
    OGRSpatialReference crs;
    crs.SetFromUserInput(spec.crs.c_str());
    d->SetSpatialRef(&crs);
  }
  for (int b = 1; b <= spec.bands; ++b) {
    GDALRasterBand* band = d->GetRasterBand(b);
    if (spec.nodata) band->SetNoDataValue(*spec.nodata);
    if (spec.scale) band->SetScale(*spec.scale);
    if (spec.offset) band->SetOffset(*spec.offset);
    if (!spec.unit.empty()) band->SetUnitType(spec.unit.c_str());
    if (spec.is_palette) {
      GDALColorTable table;
      const GDALColorEntry red{255, 0, 0, 255};
      table.SetColorEntry(1, &red);
      band->SetColorTable(&table);
    }
    if (!value) continue;
    std::vector<double> row(static_cast<std::size_t>(spec.width));
    for (int j = 0; j < spec.height; ++j) {
      for (int i = 0; i < spec.width; ++i) row[static_cast<std::size_t>(i)] = value(i, j, b);
      if (band->RasterIO(GF_Write, 0, j, spec.width, 1, row.data(), spec.width, 1, GDT_Float64, 0, 0,
                         nullptr) != CE_None)
        break;
    }
  }
  GDALClose(d);
}

// Smooth hills with a fine grain, different at every post; exactly representable in float32.
inline double hills(int i, int j) {
  const auto n = static_cast<std::uint32_t>(i) * 2654435761U ^ static_cast<std::uint32_t>(j) * 2246822519U;
  return ((i * 7 + j * 5) % 400) + static_cast<double>((n >> 20) & 63) / 64.0;
}

inline IngestKernels real_kernels() {
  return {[](const PostWindow& coarse, const PostWindow& world) { return analysis_window(coarse, world); },
          [](const HeightGrid& fine, const PostWindow& world, const PostWindow& coarse) {
            return analyse(fine, world, coarse);
          },
          nullptr};
}

inline IngestOptions options_for(const std::string& layer, std::vector<std::string> sources) {
  IngestOptions options;
  options.layer = layer;
  options.sources = std::move(sources);
  return options;
}

// Ingests and opens the layer.
inline Result<std::shared_ptr<LayerStore>> ingest_and_open(const std::filesystem::path& data_dir,
                                                           const IngestOptions& options) {
  auto info = ingest(data_dir, options, real_kernels(), nullptr);
  if (!info) return info.error();
  return LayerStore::open(data_dir, options.layer);
}

}  // namespace lodestone::testing
