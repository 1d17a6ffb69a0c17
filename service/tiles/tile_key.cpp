#include "service/tiles/tile_key.h"

#include <fmt/format.h>
#define XXH_INLINE_ALL
#include <xxhash.h>

#include <algorithm>
#include <charconv>
#include <cmath>

#include "storage/formats/quantum.h"

namespace lodestone {
namespace {

Error bad_query(std::string_view name, std::string_view value, std::string_view rule) {
  return Error{ErrorCode::kInvalidArgument, fmt::format("query {}={}: {}", name, value, rule)};
}

Result<std::int64_t> parse_index(std::string_view what, std::string_view text) {
  const bool is_digits = !text.empty() && std::all_of(text.begin(), text.end(), [](char c) { return c >= '0' && c <= '9'; });
  if (!is_digits || (text.size() > 1 && text[0] == '0')) {
    return Error{ErrorCode::kInvalidArgument,
                 fmt::format("tile address {} = \"{}\": must be a whole number, 0 or more, without sign or leading zeros", what, text)};
  }
  std::int64_t value = 0;
  const auto [end, code] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (code != std::errc() || end != text.data() + text.size()) {
    return Error{ErrorCode::kNotFound, fmt::format("tile address {} = {} is beyond any layer", what, text)};
  }
  return value;
}

Result<float> resolve_quantum(const TileKey& key, std::string_view text) {
  const LayerInfo& info = key.layer->info();
  if (text == "off" || text == "0") return 0.0F;
  if (text == "auto") {
    const double highest = std::max(std::abs(info.height_min_m), std::abs(info.height_max_m));
    return auto_quantum(highest, std::ldexp(std::min(info.cell_x_m, info.cell_y_m), info.base_level - key.id.z));
  }
  double value = 0;
  const auto [end, code] = std::from_chars(text.data(), text.data() + text.size(), value);
  int exponent = 0;
  if (code != std::errc() || end != text.data() + text.size() || std::frexp(value, &exponent) != 0.5 || value < 1.0 / 1024 || value > 64) {
    return bad_query("quantum", text, "must be off, auto or a power of two in 0.0009765625..64 (metres)");
  }
  return static_cast<float>(value);
}

Result<void> set_exr_option(TileKey& key, const std::string& name, const std::string& value) {
  if (name == "compression") {
    static const std::pair<std::string_view, ExrCompression> all[] = {{"none", ExrCompression::kNone},
                                                                      {"zip", ExrCompression::kZip},
                                                                      {"piz", ExrCompression::kPiz},
                                                                      {"pxr24", ExrCompression::kPxr24}};
    for (const auto& [word, compression] : all) {
      if (word == value) {
        key.exr.compression = compression;
        return {};
      }
    }
    return bad_query(name, value, "must be none, zip, piz or pxr24");
  }
  if (name == "pixel") {
    if (value != "half" && value != "float") return bad_query(name, value, "must be float or half");
    key.exr.pixel = value == "half" ? ExrPixel::kHalf : ExrPixel::kFloat;
    return {};
  }
  if (value != "Y" && value != "Y,provenance") return bad_query(name, value, "must be Y or Y,provenance");
  key.has_provenance_channel = value != "Y";
  return {};
}

Result<void> set_png_option(TileKey& key, const std::string& name, const std::string& value) {
  if (name == "encoding") {
    static const std::pair<std::string_view, PngEncoding> all[] = {{"terrarium", PngEncoding::kTerrarium},
                                                                   {"mapbox", PngEncoding::kMapbox},
                                                                   {"hillshade", PngEncoding::kHillshade},
                                                                   {"relief", PngEncoding::kRelief}};
    for (const auto& [word, encoding] : all) {
      if (word == value) {
        key.png = encoding;
        return {};
      }
    }
    return bad_query(name, value, "must be terrarium, mapbox, hillshade or relief");
  }
  const int posts = key.layer->info().posts_per_tile;
  if (value == std::to_string(posts)) {
    key.png_size = posts;
  } else if (value == std::to_string(posts - 1)) {
    key.png_size = posts - 1;
  } else {
    return bad_query(name, value, fmt::format("must be {} (pixel centres) or {} (one pixel per post)", posts - 1, posts));
  }
  return {};
}

}  // namespace

std::string TileKey::text() const {
  std::string out = fmt::format("{}|{}|{}|{}|{}|{}|{}|", layer->info().name, layer->revision(), recipe_name,
                                recipe_text(recipe), seed, to_string(id), static_cast<int>(format));
  switch (format) {
    case TileFormat::kExr:
      out += fmt::format("{},{},{}", static_cast<int>(exr.compression), static_cast<int>(exr.pixel), has_provenance_channel);
      break;
    case TileFormat::kPng:
      out += fmt::format("{},{}", static_cast<int>(png), png_size);
      break;
    case TileFormat::kGlb:
    case TileFormat::kTerrain:
      out += mesh.text();
      break;
    case TileFormat::kF32:
    case TileFormat::kTif:
    case TileFormat::kGround:
      break;
  }
  return out + fmt::format("|{}", quantum_m);
}

CacheKey TileKey::hash() const {
  const std::string all = text();
  const XXH128_hash_t hash = XXH3_128bits(all.data(), all.size());
  return {hash.high64, hash.low64};
}

std::string TileKey::etag() const {
  const CacheKey key = hash();
  return fmt::format("{:016x}{:016x}", key.hi, key.lo);
}

std::string TileKey::tag() const { return layer->info().name + "/" + recipe_name; }

Result<void> set_format(TileKey& key, std::string_view extension, const QueryList& query) {
  static const std::pair<std::string_view, TileFormat> formats[] = {
      {"exr", TileFormat::kExr}, {"f32", TileFormat::kF32}, {"tif", TileFormat::kTif},
      {"png", TileFormat::kPng}, {"glb", TileFormat::kGlb}, {"terrain", TileFormat::kTerrain}};
  const auto* found = std::find_if(std::begin(formats), std::end(formats), [&](const auto& f) { return f.first == extension; });
  if (found == std::end(formats)) {
    return Error{ErrorCode::kNotFound, fmt::format("no tile format .{}: there are exr, f32, tif, png, glb, terrain", extension)};
  }
  key.format = found->second;
  const bool is_mesh = key.format == TileFormat::kGlb || key.format == TileFormat::kTerrain;
  key.png_size = key.layer->info().posts_per_tile - 1;
  std::string quantum = key.recipe.quantum;
  for (const auto& [name, value] : query) {
    if (name == "seed" || name == "v") continue;
    Result<void> ok;
    if (name == "quantum") {
      quantum = value;
    } else if (key.format == TileFormat::kExr && (name == "compression" || name == "pixel" || name == "channels")) {
      ok = set_exr_option(key, name, value);
    } else if (key.format == TileFormat::kPng && (name == "encoding" || name == "size")) {
      ok = set_png_option(key, name, value);
    } else if (is_mesh && is_mesh_option(key.format == TileFormat::kTerrain, name)) {
      ok = set_mesh_option(key.mesh, name, value);
    } else {
      ok = Error{ErrorCode::kInvalidArgument,
                 fmt::format("unknown query key {} for .{}: there are seed, v, quantum{}", name, extension,
                             key.format == TileFormat::kExr   ? ", compression, pixel, channels"
                             : key.format == TileFormat::kPng ? ", encoding, size"
                             : key.format == TileFormat::kGlb ? ", mesh, error, triangles, skirt, positions, frame"
                             : is_mesh                        ? ", error, triangles"
                                                              : "")};
    }
    if (!ok) return ok;
  }
  auto resolved = resolve_quantum(key, quantum);
  if (!resolved) return resolved.error();
  key.quantum_m = *resolved;
  if (is_mesh) return check_mesh_options(key);
  return {};
}

Result<TileId> parse_tile_id(const LayerInfo& layer, std::string_view z, std::string_view x, std::string_view y) {
  const auto level = parse_index("z", z);
  if (!level) return level.error();
  const auto column = parse_index("x", x);
  if (!column) return column.error();
  const auto row = parse_index("y", y);
  if (!row) return row.error();
  if (*level > layer.max_level()) {
    return Error{ErrorCode::kNotFound, fmt::format("tile {}/{}/{}: layer {} has levels 0..{}", z, x, y, layer.name, layer.max_level())};
  }
  const TileId id{static_cast<int>(*level), *column, *row};
  if (!layer.has_tile(id)) {
    const PostWindow tiles = layer.tiles_at(id.z);
    return Error{ErrorCode::kNotFound, fmt::format("tile {}/{}/{}: at level {} layer {} has x {}..{}, y {}..{}", z, x, y, z, layer.name,
                                                   tiles.i0, tiles.i1, tiles.j0, tiles.j1)};
  }
  return id;
}

std::string_view content_type(TileFormat format) {
  switch (format) {
    case TileFormat::kExr:
      return "image/x-exr";
    case TileFormat::kPng:
      return "image/png";
    case TileFormat::kTif:
      return "image/tiff";
    case TileFormat::kGlb:
      return "model/gltf-binary";
    case TileFormat::kTerrain:
      return "application/vnd.quantized-mesh";
    case TileFormat::kF32:
    case TileFormat::kGround:
      break;
  }
  return "application/octet-stream";
}

}  // namespace lodestone
