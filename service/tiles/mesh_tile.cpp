#include "service/tiles/mesh_tile.h"

#include <fmt/format.h>

#include <algorithm>
#include <charconv>
#include <cmath>
#include <nlohmann/json.hpp>
#include <numbers>
#include <vector>

#include "kernels/mesh/tin.h"
#include "service/http/encoding.h"
#include "service/tiles/tile_key.h"
#include "storage/formats/glb.h"
#include "storage/formats/quantized_mesh.h"

namespace lodestone {
namespace {

constexpr double kCesiumRootError_m = 77067.34;
constexpr int kFlatPosts = 33;
// Down to this level a globe's tiles are even grids of kFlatPosts - 1 cells a side: a bound of kilometres would leave two triangles,
// far below the ellipsoid in the middle. The bound holds: it is larger than the relief of the Earth.
constexpr int kRoundLevels = 3;
constexpr int kWaterPixels = 256;
// Further above the data a water mask would have to be averaged whole for every tile.
constexpr int kWaterLevelsAboveBase = 5;

Error bad_query(std::string_view name, std::string_view value, std::string_view rule) {
  return Error{ErrorCode::kInvalidArgument, fmt::format("query {}={}: {}", name, value, rule)};
}

template <class T>
std::optional<T> number_from(const std::string& text) {
  T value{};
  const auto [end, code] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (text.empty() || code != std::errc() || end != text.data() + text.size()) return {};
  return value;
}

double mercator_lat_deg(double share) {  // 0: north edge of the square world, 1: south edge
  return std::atan(std::sinh(std::numbers::pi * (1 - 2 * share))) * 180 / std::numbers::pi;
}

GeodeticFrame geodetic_frame(const LayerInfo& info, const TileId& id) {
  const double tiles = std::ldexp(1.0, id.z);
  const auto x = static_cast<double>(id.x);
  const auto y = static_cast<double>(id.y);
  if (info.grid == GridKind::kWorldCrs84Quad) {
    const double size = 180 / tiles;
    return {-180 + x * size, 90 - (y + 1) * size, -180 + (x + 1) * size, 90 - y * size, false};
  }
  return {-180 + 360 * x / tiles, mercator_lat_deg((y + 1) / tiles), -180 + 360 * (x + 1) / tiles, mercator_lat_deg(y / tiles), true};
}

// Post spacing on the ground at the layer's centre, metres east and south: the same for all tiles of a level.
std::array<double, 2> spacing_m(const LayerInfo& info, int z) {
  const int up = info.base_level - z;
  return {std::ldexp(info.cell_x_m, up), std::ldexp(info.cell_y_m, up)};
}

PlanarFrame planar_frame(const LayerInfo& info, const TileId& id) {
  const auto spacing = spacing_m(info, id.z);
  const PostWindow window = info.tile_window(id);
  const int up = info.base_level - id.z;
  return {(std::ldexp(static_cast<double>(window.i0), up) - static_cast<double>(info.world.i0)) * info.cell_x_m,
          (std::ldexp(static_cast<double>(window.j0), up) - static_cast<double>(info.world.j0)) * info.cell_y_m, spacing[0], spacing[1]};
}

// The mesh within `error_m` inside; the tile's edges keep the bound of the options, which both neighbours know.
Result<TinMesh> build(const TileKey& key, const PostField& field, std::optional<double> error_m, double edge_error_m) {
  const PostWindow window = key.layer->info().tile_window(key.id);
  const bool is_round = key.format == TileFormat::kTerrain && key.id.z <= kRoundLevels && !key.mesh.error_m && !key.mesh.triangles;
  if (is_round) return build_grid_mesh(field, window.i0, window.j0, std::max(1, (field.cols - 1) / (kFlatPosts - 1)));
  if (key.mesh.kind == MeshKind::kGrid) {
    // The step follows from the budget alone, so neighbours have the same.
    std::int32_t step = 1;
    const auto cells = static_cast<std::uint64_t>(field.cols - 1);
    while (key.mesh.triangles && static_cast<std::uint64_t>(step) < cells &&
           2 * (cells / static_cast<std::uint64_t>(step)) * (cells / static_cast<std::uint64_t>(step)) > *key.mesh.triangles) {
      step *= 2;
    }
    return build_grid_mesh(field, window.i0, window.j0, step);
  }
  TinRequest request;
  request.field = field;
  request.i0 = window.i0;
  request.j0 = window.j0;
  request.max_error_m = error_m;
  if (key.mesh.triangles) request.max_triangles = *key.mesh.triangles;
  request.edge_error_m = edge_error_m;
  return build_tin(request);
}

Result<std::string> encode(const TileKey& key, const TinMesh& mesh) {
  const LayerInfo& info = key.layer->info();
  GlbOptions options;
  if (key.mesh.is_earth_centred) {
    options.frame = geodetic_frame(info, key.id);
  } else {
    options.frame = planar_frame(info, key.id);
  }
  options.is_quantized = key.mesh.is_quantized;
  options.name = fmt::format("{} {}", info.name, to_string(key.id));
  options.extras = {{"layer", info.name}, {"recipe", key.recipe_name},   {"revision", key.layer->revision()},
                    {"tile", to_string(key.id)}, {"seed", std::to_string(key.seed)}, {"datum", info.datum}};
  return encode_glb(mesh, options);
}

// 0 land, 255 water, from the layer's mask named "water"; one byte when the tile is all of one kind.
Result<std::vector<std::uint8_t>> watermask(const TileKey& key) {
  const LayerInfo& info = key.layer->info();
  const std::string names[] = {"water"};
  const int level = key.id.z - info.base_level;
  if (key.layer->resolve_masks({names[0]}).empty() || level < -kWaterLevelsAboveBase) return std::vector<std::uint8_t>{0};
  const PostWindow window = info.tile_window(key.id);
  const std::int64_t cells = info.cells_per_tile();
  const auto origin = [&](std::int64_t tile, std::int64_t world) {
    return tile - (level >= 0 ? world << level : floor_shift(world, -level));
  };
  const std::int64_t i0 = origin(window.i0, info.world.i0);
  const std::int64_t j0 = origin(window.j0, info.world.j0);
  auto crop = key.layer->masks().crop(names, level, {i0, j0, i0 + cells - 1, j0 + cells - 1});
  if (!crop) return crop.error();
  std::vector<std::uint8_t> out;
  for (std::int64_t row = 0; row < kWaterPixels; ++row) {
    for (std::int64_t column = 0; column < kWaterPixels; ++column) {
      out.push_back(crop->pixels[static_cast<std::size_t>(row * cells / kWaterPixels * cells + column * cells / kWaterPixels)]);
    }
  }
  if (std::all_of(out.begin(), out.end(), [&](std::uint8_t v) { return v == out[0]; })) out.resize(1);
  return out;
}

Result<MeshTile> terrain_tile(const TileKey& key, const TinMesh& mesh, std::uint8_t provenance_bits) {
  const LayerInfo& info = key.layer->info();
  QuantizedMeshOptions options;
  options.frame = geodetic_frame(info, key.id);
  MeshTile tile;
  tile.max_error_m = mesh.max_error_m + quantized_mesh_slack_m(mesh, options.frame);
  options.has_normals = (key.mesh.extensions & kTerrainNormals) != 0;
  std::vector<std::uint8_t> water;
  if ((key.mesh.extensions & kTerrainWatermask) != 0) {
    auto mask = key.mesh.is_flat ? Result<std::vector<std::uint8_t>>(std::vector<std::uint8_t>{0}) : watermask(key);
    if (!mask) return mask.error();
    water = std::move(*mask);
    options.watermask = water;
  }
  if ((key.mesh.extensions & kTerrainMetadata) != 0) {
    options.metadata_json = nlohmann::ordered_json{{"geometricerror", tile.max_error_m},
                                                   {"rmsErrorM", mesh.rms_error_m},
                                                   {"layer", info.name},
                                                   {"recipe", key.recipe_name},
                                                   {"seed", std::to_string(key.seed)},
                                                   {"revision", key.layer->revision()},
                                                   {"datum", info.datum},
                                                   {"provenanceBits", provenance_bits}}
                                .dump();
  }
  auto body = encode_quantized_mesh(mesh, options);
  if (!body) return body.error();
  tile.body = std::move(*body);
  if (key.mesh.is_gzip) {
    auto coded = http::gzip_compressed(tile.body);
    if (!coded) return coded.error();
    tile.body = std::move(*coded);
  }
  return tile;
}

}  // namespace

std::string MeshOptions::text() const {
  return fmt::format("{},{},{},{},{},{},{},{},{}", static_cast<int>(kind), error_m ? fmt::format("{}", *error_m) : "-",
                     triangles ? fmt::format("{}", *triangles) : "-", skirt_m, is_quantized, is_earth_centred, extensions, is_gzip, is_flat);
}

bool is_mesh_option(bool is_terrain, std::string_view name) {
  if (name == "error" || name == "triangles") return true;
  return !is_terrain && (name == "mesh" || name == "skirt" || name == "positions" || name == "frame");
}

Result<void> set_mesh_option(MeshOptions& options, const std::string& name, const std::string& value) {
  if (name == "mesh") {
    if (value != "tin" && value != "grid") return bad_query(name, value, "must be tin or grid");
    options.kind = value == "tin" ? MeshKind::kTin : MeshKind::kGrid;
  } else if (name == "error") {
    const auto error = number_from<double>(value);
    if (!error || !(*error >= 0 && *error <= 1e6)) return bad_query(name, value, "must be metres, 0..1000000");
    options.error_m = *error;
  } else if (name == "triangles") {
    const auto count = number_from<std::uint64_t>(value);
    if (!count || *count < 2 || *count > (std::uint64_t{1} << 24)) return bad_query(name, value, "must be a whole number, 2..16777216");
    options.triangles = *count;
  } else if (name == "skirt") {
    const auto depth = number_from<double>(value);
    if (value != "auto" && value != "none" && (!depth || !(*depth >= 0 && *depth <= 1e6))) {
      return bad_query(name, value, "must be none, auto or metres in 0..1000000");
    }
    options.skirt_m = value == "auto" ? -1 : depth.value_or(0);
  } else if (name == "positions") {
    if (value != "float" && value != "quantized") return bad_query(name, value, "must be float or quantized");
    options.is_quantized = value == "quantized";
  } else {
    if (value != "plane" && value != "ecef") return bad_query(name, value, "must be plane or ecef");
    options.is_earth_centred = value == "ecef";
  }
  return {};
}

Result<void> check_mesh_options(const TileKey& key) {
  const LayerInfo& info = key.layer->info();
  const auto refuse = [](const std::string& rule) { return Error{ErrorCode::kInvalidArgument, rule}; };
  if (key.mesh.kind == MeshKind::kGrid && key.mesh.error_m) {
    return refuse("query error does not go with mesh=grid, whose step must be the same in all tiles: use triangles, or mesh=tin");
  }
  if (key.mesh.is_quantized && key.mesh.is_earth_centred) return refuse("query positions=quantized needs frame=plane");
  const bool needs_globe = key.format == TileFormat::kTerrain || key.mesh.is_earth_centred;
  if (needs_globe && info.grid == GridKind::kNative) {
    return refuse(fmt::format("layer {} has the grid native; {} needs a layer ingested with --grid WorldCRS84Quad or WebMercatorQuad", info.name,
                              key.format == TileFormat::kTerrain ? "quantized-mesh" : "frame=ecef"));
  }
  return {};
}

std::uint8_t terrain_extensions(std::string_view accept) {
  constexpr std::string_view kType = "application/vnd.quantized-mesh";
  constexpr std::string_view kKey = "extensions=";
  std::uint8_t bits = 0;
  while (!accept.empty()) {
    const std::size_t comma = accept.find(',');
    const std::string_view member = http::trimmed(accept.substr(0, comma));
    accept.remove_prefix(comma == std::string_view::npos ? accept.size() : comma + 1);
    const std::size_t at = member.find(kKey);
    if (member.substr(0, kType.size()) != kType || at == std::string_view::npos) continue;
    std::string_view list = member.substr(at + kKey.size());
    list = http::trimmed(list.substr(0, list.find(';')));
    while (!list.empty()) {
      const std::size_t dash = list.find('-');
      const std::string_view word = list.substr(0, dash);
      list.remove_prefix(dash == std::string_view::npos ? list.size() : dash + 1);
      if (word == "octvertexnormals") bits |= kTerrainNormals;
      if (word == "watermask") bits |= kTerrainWatermask;
      if (word == "metadata") bits |= kTerrainMetadata;
    }
  }
  return bits;
}

double default_mesh_error_m(const LayerInfo& info, int z) {
  if (info.grid == GridKind::kWorldCrs84Quad) return std::ldexp(kCesiumRootError_m, -z);
  const auto spacing = spacing_m(info, z);
  return std::min(spacing[0], spacing[1]) / 2;
}

Result<MeshTile> make_mesh_tile(const TileKey& key, std::span<const float> with_halo_m, std::uint8_t provenance_bits) {
  const LayerInfo& info = key.layer->info();
  const PostField field{with_halo_m, {}, info.posts_per_tile, info.posts_per_tile, 1};
  const bool is_terrain = key.format == TileFormat::kTerrain;
  const bool is_budget_only = key.mesh.triangles && !key.mesh.error_m;
  const double asked_m = key.mesh.error_m.value_or(default_mesh_error_m(info, key.id.z));
  // Half the bound on the edges of a .terrain leaves room for its rounding, without asking the neighbour.
  const double edge_m = is_terrain ? asked_m / 2 : asked_m;
  const std::optional<double> bound = is_budget_only ? std::nullopt : std::optional(asked_m);
  auto mesh = build(key, field, bound, edge_m);
  if (!mesh) return mesh.error();
  if (is_terrain && bound) {
    const double slack = quantized_mesh_slack_m(*mesh, geodetic_frame(info, key.id));
    if (mesh->max_error_m + slack > asked_m && slack * 1.25 < asked_m) {
      mesh = build(key, field, asked_m - 1.25 * slack, edge_m);
      if (!mesh) return mesh.error();
    }
  }
  const auto spacing = spacing_m(info, key.id.z);
  set_normals(*mesh, field, spacing[0], spacing[1]);
  if (is_terrain) return terrain_tile(key, *mesh, provenance_bits);
  if (key.mesh.skirt_m != 0) {
    // A neighbour one level up may be off by its own bound, twice ours.
    add_skirt(*mesh, key.mesh.skirt_m > 0 ? static_cast<float>(key.mesh.skirt_m) : skirt_depth_m(*mesh, 2 * asked_m));
  }
  auto body = encode(key, *mesh);
  if (!body) return body.error();
  double step_m = 0;
  if (key.mesh.is_quantized) {
    const auto [low, high] = std::minmax_element(mesh->vertices.begin(), mesh->vertices.end(),
                                                 [](const TinVertex& a, const TinVertex& b) { return a.height_m < b.height_m; });
    step_m = (static_cast<double>(high->height_m) - low->height_m) / 65535;
  }
  return MeshTile{std::move(*body), mesh->max_error_m + step_m / 2};
}

Result<MeshTile> make_flat_tile(const TileKey& key) {
  const std::vector<float> heights(std::size_t{kFlatPosts} * kFlatPosts, 0.0F);
  const PostField field{heights, {}, kFlatPosts, kFlatPosts, 0};
  auto mesh = build_grid_mesh(field, 0, 0, 1);
  if (!mesh) return mesh.error();
  set_normals(*mesh, field, 1, 1);
  return terrain_tile(key, *mesh, 2);
}

}  // namespace lodestone
