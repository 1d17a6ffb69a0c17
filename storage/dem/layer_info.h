#pragma once
// LayerInfo: what is known about a layer, as plain values; stored as JSON beside the tiles (storage/FORMAT.md).

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "kernels/types/analysis.h"
#include "kernels/types/post_window.h"
#include "kernels/types/result.h"
#include "kernels/types/tile_id.h"

namespace lodestone {

enum class GridKind : std::uint8_t { kNative, kWorldCrs84Quad, kWebMercatorQuad };
std::string_view to_string(GridKind kind);  // "native", "WorldCRS84Quad", "WebMercatorQuad"
Result<GridKind> grid_kind_from(std::string_view name);

// World coordinates of post (i, j) of the base level: x = a[0] + i a[1] + j a[2], y = a[3] + i a[4] + j a[5] (GDAL's order,
// but for posts: a[0], a[3] is the centre of the north-west pixel).
using PostTransform = std::array<double, 6>;

// WGS84 longitude/latitude box: west, south, east, north, degrees.
using GeoBox = std::array<double, 4>;

struct MaskInfo {
  std::string name;
  int level = 0;                  // 2^level pixels per data cell edge
  std::uint64_t source_hash = 0;  // XXH3 of the uploaded bytes
  std::int64_t width = 0, height = 0;  // pixels
  double mean = 0;                // of the stored pixels, 0..1
};

struct LayerInfo {
  std::string name;
  GridKind grid = GridKind::kNative;
  std::string crs_wkt;            // WKT2 of the layer's CRS
  std::string crs_name;           // "EPSG:4326" where the CRS has a code, else its name
  PostTransform transform{};      // of global post indices at the base level
  PostWindow world;               // posts of the data at the base level, global indices; native: (0, 0, width-1, height-1)
  int posts_per_tile = 257;       // 2^n + 1
  int base_level = 0;
  std::string datum;              // vertical datum as the operator or the file named it; "unknown" otherwise
  double height_min_m = 0, height_max_m = 0;  // of surveyed posts
  std::int64_t void_posts = 0;
  std::vector<std::string> sources;           // file names, highest priority first
  std::string source_digest;                  // hex XXH3-128 over heights and flags of all base tiles and the ingest options
  std::vector<LevelVariance> variances;       // finest (s = -1) first
  std::array<double, 4> bounds{};             // min x, min y, max x, max y of the posts in the layer's CRS
  GeoBox bounds_wgs84{};
  double cell_x_m = 0, cell_y_m = 0;          // size of a base cell on the ground at the layer's centre, metres

  int cells_per_tile() const { return posts_per_tile - 1; }
  int max_level() const;          // base_level + 16
  // Posts of `level`'s data in that level's global indices; level <= base: analysis posts inside the data,
  // level > base: finer(world, level - base).
  PostWindow world_at(int level) const;
  // True if tile `id` exists: 0 <= z <= max_level and the tile holds at least one cell (or post) of the data.
  bool has_tile(const TileId& id) const;
  // Tiles of level z that exist, as an inclusive rectangle of x, y.
  PostWindow tiles_at(int level) const;
  // Posts of tile `id` in its level's global indices.
  PostWindow tile_window(const TileId& id) const;
  // World coordinates of a (fractional) post of `level`, and back.
  std::array<double, 2> world_from_post(int level, double i, double j) const;
  std::array<double, 2> post_from_world(int level, double x, double y) const;
};

// JSON text of all fields, and back. Errors: kCorrupt (missing or mistyped field, named).
std::string layer_info_json(const LayerInfo& info);
Result<LayerInfo> layer_info_from_json(std::string_view text);

// Rule for names of layers, masks, recipes: 1..64 of [A-Za-z0-9._-], not starting with '.'. Error: kInvalidArgument.
Result<void> check_name(std::string_view what, std::string_view name);

}  // namespace lodestone
