#include "storage/dem/layer_info.h"

#include <algorithm>
#include <cmath>
#include <nlohmann/json.hpp>

namespace lodestone {
namespace {

using nlohmann::json;

constexpr int kSyntheticLevels = 16;  // SPEC: depth limit below the data

// Tiles [first, last] along one axis that hold a cell of [lo, hi], tiles being `span` posts wide; one post:
// its own tile.
std::array<std::int64_t, 2> tile_range(std::int64_t lo, std::int64_t hi, std::int64_t span) {
  const auto floor_div = [span](std::int64_t a) { return a >= 0 ? a / span : -((-a + span - 1) / span); };
  return {floor_div(lo), floor_div(hi > lo ? hi - 1 : lo)};
}

// A required member of the stored JSON; the name goes into the error.
template <class T>
Result<void> take(const json& object, const char* name, T& out) {
  const auto found = object.find(name);
  if (found == object.end()) {
    return Error{ErrorCode::kCorrupt,
                 std::string("layer info: field \"") + name + "\" is missing; ingest the layer again"};
  }
  try {
    found->get_to(out);
  } catch (const json::exception& e) {
    return Error{ErrorCode::kCorrupt,
                 std::string("layer info: field \"") + name + "\": " + e.what() + "; ingest the layer again"};
  }
  return {};
}

}  // namespace

std::string_view to_string(GridKind kind) {
  switch (kind) {
    case GridKind::kNative:
      return "native";
    case GridKind::kWorldCrs84Quad:
      return "WorldCRS84Quad";
    case GridKind::kWebMercatorQuad:
      return "WebMercatorQuad";
  }
  return "?";
}

Result<GridKind> grid_kind_from(std::string_view name) {
  for (const GridKind kind : {GridKind::kNative, GridKind::kWorldCrs84Quad, GridKind::kWebMercatorQuad}) {
    if (to_string(kind) == name) return kind;
  }
  return Error{
      ErrorCode::kInvalidArgument,
      "grid \"" + std::string(name) + "\" is unknown; use native, WorldCRS84Quad or WebMercatorQuad"};
}

int LayerInfo::max_level() const { return base_level + kSyntheticLevels; }

PostWindow LayerInfo::world_at(int level) const {
  if (level >= base_level) return finer(world, level - base_level);
  PostWindow w = world;
  for (int n = base_level; n > level; --n) w = coarse_world(w);
  return w;
}

PostWindow LayerInfo::tiles_at(int level) const {
  // Counted at the base level or below, so that a tile that holds a cell of the data always has its parent.
  const int reference = std::max(level, base_level);
  const PostWindow w = world_at(reference);
  const std::int64_t span = static_cast<std::int64_t>(cells_per_tile()) << (reference - level);
  const auto x = tile_range(w.i0, w.i1, span);
  const auto y = tile_range(w.j0, w.j1, span);
  return {x[0], y[0], x[1], y[1]};
}

bool LayerInfo::has_tile(const TileId& id) const {
  return id.z >= 0 && id.z <= max_level() && tiles_at(id.z).contains(id.x, id.y);
}

PostWindow LayerInfo::tile_window(const TileId& id) const {
  const std::int64_t n = cells_per_tile();
  return {id.x * n, id.y * n, (id.x + 1) * n, (id.y + 1) * n};
}

std::array<double, 2> LayerInfo::world_from_post(int level, double i, double j) const {
  const double u = std::ldexp(i, base_level - level);
  const double v = std::ldexp(j, base_level - level);
  return {transform[0] + u * transform[1] + v * transform[2],
          transform[3] + u * transform[4] + v * transform[5]};
}

std::array<double, 2> LayerInfo::post_from_world(int level, double x, double y) const {
  const double dx = x - transform[0];
  const double dy = y - transform[3];
  const double det = transform[1] * transform[5] - transform[2] * transform[4];
  const double u = (dx * transform[5] - dy * transform[2]) / det;
  const double v = (dy * transform[1] - dx * transform[4]) / det;
  return {std::ldexp(u, level - base_level), std::ldexp(v, level - base_level)};
}

std::string layer_info_json(const LayerInfo& info) {
  json variances = json::array();
  for (const LevelVariance& level : info.variances) {
    json bands = json::array();
    for (const BandVariance& band : level)
      bands.push_back({{"variance_m2", band.variance_m2}, {"count", band.count}});
    variances.push_back(bands);
  }
  const PostWindow& w = info.world;
  const json text = {{"name", info.name},
                     {"grid", to_string(info.grid)},
                     {"crs_wkt", info.crs_wkt},
                     {"crs_name", info.crs_name},
                     {"transform", info.transform},
                     {"world", {w.i0, w.j0, w.i1, w.j1}},
                     {"posts_per_tile", info.posts_per_tile},
                     {"base_level", info.base_level},
                     {"datum", info.datum},
                     {"height_min_m", info.height_min_m},
                     {"height_max_m", info.height_max_m},
                     {"void_posts", info.void_posts},
                     {"sources", info.sources},
                     {"source_digest", info.source_digest},
                     {"variances", variances},
                     {"bounds", info.bounds},
                     {"bounds_wgs84", info.bounds_wgs84},
                     {"cell_x_m", info.cell_x_m},
                     {"cell_y_m", info.cell_y_m}};
  // File names need not be UTF-8; they are for reading only.
  return text.dump(-1, ' ', false, json::error_handler_t::replace);
}

Result<LayerInfo> layer_info_from_json(std::string_view text) {
  const json object = json::parse(text, nullptr, false);
  if (!object.is_object())
    return Error{ErrorCode::kCorrupt, "layer info: not a JSON object; ingest the layer again"};
  LayerInfo info;
  std::string grid;
  std::array<std::int64_t, 4> world{};
  json variances;
  Result<void> ok;
  const auto field = [&](const char* name, auto& out) {
    if (ok) ok = take(object, name, out);
  };
  field("name", info.name);
  field("grid", grid);
  field("crs_wkt", info.crs_wkt);
  field("crs_name", info.crs_name);
  field("transform", info.transform);
  field("world", world);
  field("posts_per_tile", info.posts_per_tile);
  field("base_level", info.base_level);
  field("datum", info.datum);
  field("height_min_m", info.height_min_m);
  field("height_max_m", info.height_max_m);
  field("void_posts", info.void_posts);
  field("sources", info.sources);
  field("source_digest", info.source_digest);
  field("variances", variances);
  field("bounds", info.bounds);
  field("bounds_wgs84", info.bounds_wgs84);
  field("cell_x_m", info.cell_x_m);
  field("cell_y_m", info.cell_y_m);
  if (!ok) return ok.error();
  info.world = {world[0], world[1], world[2], world[3]};
  auto kind = grid_kind_from(grid);
  if (!kind) return Error{ErrorCode::kCorrupt, "layer info: " + kind.error().message};
  info.grid = *kind;
  const int cells = info.posts_per_tile - 1;
  if (cells < 1 || (cells & (cells - 1)) != 0 || info.base_level < 0 || info.base_level > 40 ||
      info.world.is_empty()) {
    return Error{ErrorCode::kCorrupt,
                 "layer info: posts_per_tile, base_level or world out of range; ingest the layer again"};
  }
  try {
    for (const json& level : variances) {
      LevelVariance bands{};
      for (std::size_t t = 0; t < bands.size(); ++t) {
        bands[t] = {level.at(t).at("variance_m2").get<double>(), level.at(t).at("count").get<std::int64_t>()};
      }
      info.variances.push_back(bands);
    }
  } catch (const json::exception& e) {
    return Error{ErrorCode::kCorrupt,
                 std::string("layer info: field \"variances\": ") + e.what() + "; ingest the layer again"};
  }
  return info;
}

Result<void> check_name(std::string_view what, std::string_view name) {
  const auto allowed = [](char c) {
    return (c >= 'A' && c <= 'Z') || (c >= 'a' && c <= 'z') || (c >= '0' && c <= '9') || c == '.' ||
           c == '_' || c == '-';
  };
  if (name.empty() || name.size() > 64 || name[0] == '.' || !std::all_of(name.begin(), name.end(), allowed)) {
    return Error{
        ErrorCode::kInvalidArgument,
        std::string(what) + " name breaks the rule: 1 to 64 of A-Z a-z 0-9 . _ - and no dot in front"};
  }
  return {};
}

}  // namespace lodestone
