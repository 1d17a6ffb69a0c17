#pragma once
// MaskStore: the masks of one layer, warped to its data cells. Beside the generations, so a new ingest keeps them.

#include <cstdint>
#include <filesystem>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "kernels/types/mask_crop.h"
#include "kernels/types/post_window.h"
#include "kernels/types/result.h"
#include "storage/dem/layer_info.h"

namespace lodestone {

// Thread-safe. Pixels: 0 keeps all detail energy, 255 (white, 1.0) removes it.
class MaskStore {
 public:
  static Result<std::shared_ptr<MaskStore>> open(const std::filesystem::path& data_dir, const LayerInfo& layer);
  virtual ~MaskStore() = default;

  virtual std::vector<MaskInfo> list() const = 0;  // sorted by name
  // Decodes PNG, EXR or GeoTIFF bytes (georeferenced: warped to the layer's CRS; without georeference: stretched over the
  // layer's cells) and stores them: acknowledged = durable. `level` chosen so that aligned pixels are kept exactly
  // (0..3), else area average at the nearest level of those (coarser where that would be over 2^28 pixels). Outside the
  // raster and at its nodata: 0. Grey 0..1 is the integer type's range, or 0..1 itself for floats (clamped); an integer raster
  // without values over 1 is a 0/1 mask. Colours: the mean of the channels; alpha is ignored.
  // Errors: kTooLarge (declared size over 2^26 pixels, a side over 65536, or 2^28 bytes, before decoding), kUnsupported (other
  // format, colour table, deep EXR), kCorrupt (does not decode), kInvalidArgument (name; layer without cells; raster beside
  // the layer), kConflict, kIo.
  virtual Result<MaskInfo> put(const std::string& name, std::span<const std::uint8_t> bytes) = 0;
  // The mask as an 8-bit GeoTIFF or PNG on its own pixel grid. Error: kNotFound.
  virtual Result<std::string> get(const std::string& name, const std::string& extension) const = 0;
  virtual Result<void> remove(const std::string& name) = 0;  // kNotFound
  // Pixels of `window` at `level` (pixel coordinates of MaskCrop), mirrored beyond the world; the maximum over `names`,
  // each brought to `level` (finer: replicated, coarser: mean rounded to nearest). Errors: kNotFound (names the mask), kCorrupt.
  virtual Result<MaskCrop> crop(std::span<const std::string> names, int level, const PostWindow& window) const = 0;
  // The finest level among `names`.
  virtual Result<int> finest_level(std::span<const std::string> names) const = 0;
  // Changes whenever a mask is put or removed: XXH3 over names, levels and pixels.
  virtual std::uint64_t digest() const = 0;
};

}  // namespace lodestone
