#pragma once
// TileKey: everything that the bytes of one served tile depend on. Same key, same bytes, on every machine (I1).

#include <memory>
#include <span>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "kernels/types/result.h"
#include "kernels/types/tile_id.h"
#include "service/config/recipe.h"
#include "service/ground/layer.h"
#include "service/tiles/mesh_tile.h"
#include "storage/cache/memory_cache.h"
#include "storage/formats/exr_tile.h"
#include "storage/formats/raster_tile.h"

namespace lodestone {

// kGround is for our own use (/heights): the f32 tile followed by one Provenance byte per post.
enum class TileFormat : std::uint8_t { kExr, kF32, kTif, kPng, kGround, kGlb, kTerrain };

struct TileKey {
  std::shared_ptr<const Layer> layer;
  std::string recipe_name;
  Recipe recipe;
  std::uint64_t seed = 0;
  TileId id;
  TileFormat format = TileFormat::kExr;
  ExrOptions exr;
  bool has_provenance_channel = false;
  float quantum_m = 0;  // 0: heights as they are
  PngEncoding png = PngEncoding::kTerrarium;
  int png_size = 0;     // 257 or 256 for tiles of 257 posts
  MeshOptions mesh;     // kGlb, kTerrain

  std::string text() const;  // canonical: all of the above, with the layer's revision
  CacheKey hash() const;     // XXH3-128 of text()
  std::string etag() const;  // opaque part: 32 hexadecimal digits
  std::string tag() const;   // "layer/recipe", for purges
};

using QueryList = std::vector<std::pair<std::string, std::string>>;

// Fills format and options from the extension and the query (seed and v are known and left alone; other keys that the format
// does not have are errors). Error: kInvalidArgument or kUnsupported (extension), names the key, the value and what is allowed.
Result<void> set_format(TileKey& key, std::string_view extension, const QueryList& query);

// z, x, y in decimal. Errors: kInvalidArgument (not a whole number; negative), kNotFound (beyond the layer's levels or bounds:
// says what they are).
Result<TileId> parse_tile_id(const LayerInfo& layer, std::string_view z, std::string_view x, std::string_view y);

// "image/x-exr", "image/png", "image/tiff", "model/gltf-binary", "application/vnd.quantized-mesh" or "application/octet-stream".
std::string_view content_type(TileFormat format);

}  // namespace lodestone
