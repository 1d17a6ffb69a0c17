#pragma once
// Rasters as ingest sees them: checked, placed on one grid of posts, read window by window in metres.

#include <cstdint>
#include <filesystem>
#include <memory>
#include <string>
#include <vector>

#include "kernels/types/post_window.h"
#include "kernels/types/result.h"
#include "storage/dem/ingest.h"

class GDALDataset;

namespace lodestone {

struct DatasetCloser {
  void operator()(GDALDataset* dataset) const noexcept;
};
using DatasetPtr = std::unique_ptr<GDALDataset, DatasetCloser>;

// Loads GDAL's drivers and bounds its block cache, once. Every entry into GDAL goes through here first.
void prepare_gdal();
// Silences GDAL's error printing on this thread while alive.
class QuietGdal {
 public:
  QuietGdal();
  ~QuietGdal();
  QuietGdal(const QuietGdal&) = delete;
  QuietGdal& operator=(const QuietGdal&) = delete;
};

// One raster, as checked at the start.
struct PlannedRaster {
  std::string path;
  std::int64_t width = 0, height = 0;
  bool flip_x = false, flip_y = false;  // columns run west, rows run north in the file
  std::int64_t i0 = 0, j0 = 0;          // post of the layer's base level under the first (flipped) pixel
  double nodata = 0;                    // in raw values
  bool has_nodata = false, has_mask = false,
       is_wide = false;          // is_wide: float32 would lose bits of the raw values
  double scale = 1, offset = 0;  // metres = (raw * scale + offset) * unit_m
  double unit_m = 1;
  int block_width = 0, block_height = 0;
};

// All sources and the grid that they give. `info` has everything that is known before reading posts.
struct RasterPlan {
  LayerInfo info;
  std::vector<PlannedRaster> rasters;  // highest priority first
  int band = 1;
};

// Opens and checks every source, chooses grid, world and base level. Errors as ingest().
Result<RasterPlan> plan_rasters(const IngestOptions& options);

// Reads posts; one reader per thread.
class RasterReader {
 public:
  static Result<RasterReader> open(const RasterPlan& plan);
  // Metres of base-level posts `window` (inside the world), NaN where no source has data. The span holds
  // width * height floats.
  Result<void> read(const PostWindow& window, std::vector<float>& heights_m);

 private:
  RasterReader() = default;
  const RasterPlan* plan_ = nullptr;
  std::vector<DatasetPtr> files_;   // as on disk
  std::vector<DatasetPtr> warped_;  // on the layer's grid (quad grids only)
  std::vector<float> narrow_;
  std::vector<double> wide_;
  std::vector<std::uint8_t> mask_;
};

}  // namespace lodestone
