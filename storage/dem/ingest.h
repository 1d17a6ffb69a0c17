#pragma once
// Ingest: GDAL rasters in, one layer's quadtree out. Streams in tile-sized windows; resident memory does not grow with the raster.

#include <filesystem>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "kernels/types/analysis.h"
#include "kernels/types/height_grid.h"
#include "kernels/types/result.h"
#include "storage/dem/layer_info.h"
#include "storage/dem/layer_store.h"

namespace lodestone {

struct IngestOptions {
  std::vector<std::string> sources;  // paths; where rasters overlap, the one named first wins; voids let the next one show
  std::string layer;
  GridKind grid = GridKind::kNative;
  int band = 1;
  std::optional<double> nodata;      // overrides the files' tag; NaN is always void
  std::string datum;                 // empty: from the file's vertical CRS, else "unknown"
  std::string unit;                  // vertical unit "m", "ft", "us-ft"; empty: from the file, else metres
  int posts_per_tile = 257;          // 65, 129, 257, 513, 1025
  int threads = 2;
};

// The mathematics that ingest needs, handed in by the caller (kernels/synthesis/roughness.h): storage links no kernels.
struct IngestKernels {
  std::function<PostWindow(const PostWindow& coarse, const PostWindow& world)> analysis_window;
  std::function<AnalysisStep(const HeightGrid& fine, const PostWindow& world, const PostWindow& coarse)> analyse;
  // Called once everything else is written, before the layer is published; its text is kept as roughness_json().
  std::function<Result<std::string>(const LayerStore& unpublished)> finish;
};

struct IngestProgress {
  std::string phase;      // "read", "fill", "levels", "roughness", "publish"
  double fraction = 0;    // of the whole ingest, 0..1
};

// Atomic: the layer is published by one rename at the end; killed before, the old layer (or none) stays and the next ingest
// sweeps what was left. Masks of an older generation are warped anew from their sources.
// Errors: kInvalidArgument, kUnsupported (driver not on the allow-list, VRT not named as .vrt by the operator), kNotFound,
// kConflict (another writer), kCorrupt (unreadable raster), kIo (disk full: nothing is left behind).
Result<LayerInfo> ingest(const std::filesystem::path& data_dir, const IngestOptions& options, const IngestKernels& kernels,
                         const std::function<void(const IngestProgress&)>& progress);

}  // namespace lodestone
