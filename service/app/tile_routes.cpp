// GET /tiles/{layer}/{recipe}/{z}/{x}/{y}.{ext}, /cesium/{layer}/{recipe}/{z}/{x}/{y}.terrain. Statuses: 200, 304, 400, 404, 406, 410, 500, 503.

#include <fmt/format.h>

#include <charconv>
#include <unordered_map>

#include "service/app/respond.h"
#include "service/app/routes.h"
#include "service/http/etag.h"

namespace lodestone {
namespace {

// What a request target resolves to while the catalog stays the same; saves the parsing and hashing of hot tiles.
struct Resolved {
  TileKey key;
  CacheKey hash;
  std::string etag, cache_control;
};

bool is_terrain(const http::Request& request) { return request.param("ext").empty() || request.param("ext") == "terrain"; }

// What the fields of a .terrain request add to its target: extensions and coding.
struct TerrainFields {
  std::uint8_t extensions = 0;
  bool is_gzip = false;
};
TerrainFields terrain_fields(const http::Request& request) {
  const auto accept = request.joined_header("Accept");
  return {terrain_extensions(accept ? *accept : std::string()),
          http::negotiate_coding(request.joined_header("Accept-Encoding"), true) == http::Coding::kGzip};
}

// Used by the io thread only.
class ResolvedTargets {
 public:
  Result<std::shared_ptr<const Resolved>> get(const std::shared_ptr<const Catalog>& catalog, const http::Request& request) {
    if (catalog->version != version_ || known_.size() > kMostTargets) {
      known_.clear();
      version_ = catalog->version;
    }
    std::string target(request.raw_target);
    if (is_terrain(request)) {
      const TerrainFields fields = terrain_fields(request);
      target += fmt::format(" {}{}", fields.extensions, fields.is_gzip ? "z" : "");
    }
    if (const auto found = known_.find(target); found != known_.end()) return found->second;
    auto key = tile_key_from(*catalog, request);
    if (!key) return key.error();
    auto resolved = std::make_shared<Resolved>();
    resolved->key = std::move(*key);
    resolved->hash = resolved->key.hash();
    resolved->etag = http::strong_etag(resolved->key.etag());
    resolved->cache_control = request.query("v") ? "public, max-age=31536000, immutable" : "public, max-age=300";
    known_.emplace(target, resolved);
    return std::shared_ptr<const Resolved>(resolved);
  }

 private:
  static constexpr std::size_t kMostTargets = 16384;
  std::uint64_t version_ = 0;
  std::unordered_map<std::string, std::shared_ptr<const Resolved>> known_;
};

std::string provenance_text(std::uint8_t bits) {
  std::string text;
  static constexpr std::string_view words[] = {"surveyed", "filled", "synthetic"};
  for (int n = 0; n < 3; ++n) {
    if ((bits >> n & 1) != 0) text += (text.empty() ? "" : ", ") + std::string(words[n]);
  }
  return text;
}

std::string timing_text(const TileAnswer& answer) {
  switch (answer.source) {
    case TileSource::kMemory:
      return "cache;desc=memory";
    case TileSource::kDisk:
      return fmt::format("cache;desc=disk, queue;dur={:.3f}", answer.queue_ms);
    case TileSource::kComputed:
      break;
  }
  return fmt::format("cache;desc=miss, queue;dur={:.3f}, ground;dur={:.3f}, encode;dur={:.3f}", answer.queue_ms, answer.ground_ms,
                     answer.encode_ms);
}

void set_terrain_fields(const TileKey& key, http::Response& response) {
  if (key.format != TileFormat::kTerrain) return;
  response.set("Vary", "Accept, Accept-Encoding");
  if (key.mesh.is_gzip && response.status == 200) response.set("Content-Encoding", "gzip");
}

http::Response tile_response(const Resolved& resolved, const TileAnswer& answer) {
  const CachedTilePtr& tile = *answer.tile;
  http::Response response;
  response.content_type = content_type(resolved.key.format);
  response.set("ETag", resolved.etag)
      .set("Cache-Control", resolved.cache_control)
      .set("Lodestone-Max-Error-M", fmt::format("{:.6g}", tile->max_error_m))
      .set("Lodestone-Provenance", provenance_text(tile->provenance))
      .set("Server-Timing", timing_text(answer));
  set_terrain_fields(resolved.key, response);
  response.body = http::Body(tile, tile->body.data(), tile->body.size());
  return response;
}

void serve_tile(App& app, const std::shared_ptr<ResolvedTargets>& targets, const std::shared_ptr<const http::Request>& request,
                http::Responder responder) {
  auto resolved = targets->get(app.catalog(), *request);
  if (!resolved) return send_error(*request, responder, resolved.error());
  if (!http::negotiate_coding(request->joined_header("Accept-Encoding"), is_terrain(*request))) {
    return responder.send(http::problem_response(406, "tiles are sent as they are (identity), which Accept-Encoding excludes", request->raw_target));
  }
  const auto none_match = request->joined_header("If-None-Match");
  if (none_match && http::none_match_names(*none_match, (*resolved)->etag)) {
    ++app.tiles().counters().not_modified_total;
    http::Response response;
    response.status = 304;
    response.set("ETag", (*resolved)->etag).set("Cache-Control", (*resolved)->cache_control);
    set_terrain_fields((*resolved)->key, response);
    return responder.send(std::move(response));
  }
  const auto shared = std::make_shared<http::Responder>(std::move(responder));
  const auto ticket = app.tiles().get((*resolved)->key, (*resolved)->hash, Priority::kInteractive,
                                      [&app, shared, request, resolved = *resolved](const TileAnswer& answer) {
                                        if (answer.tile) {
                                          shared->send(tile_response(*resolved, answer));
                                        } else {
                                          send_error(*request, *shared, answer.tile.error(), app.tiles().retry_after_s());
                                        }
                                      });
  if (ticket != 0) shared->on_abandoned([&app, ticket] { app.tiles().leave(ticket); });
}

// The row counted from the north as text, of one counted from the south; what is not a number stays as it is.
std::string row_from_tms(std::string_view z, std::string_view y) {
  int level = 0;
  std::int64_t row = 0;
  const auto level_end = std::from_chars(z.data(), z.data() + z.size(), level);
  const auto row_end = std::from_chars(y.data(), y.data() + y.size(), row);
  const bool is_leading_zero = y.size() > 1 && y[0] == '0';
  if (level_end.ec != std::errc() || level_end.ptr != z.data() + z.size() || row_end.ec != std::errc() ||
      row_end.ptr != y.data() + y.size() || is_leading_zero || level < 0 || level > 60 || row < 0) {
    return std::string(y);
  }
  const std::int64_t rows = std::int64_t{1} << level;
  // Beyond the grid: a row that no layer has.
  return std::to_string(row < rows ? rows - 1 - row : rows);
}

}  // namespace

Result<TileKey> ground_key(const Catalog& catalog, const http::Request& request, std::optional<std::string_view> seed_text) {
  TileKey key;
  auto layer = catalog.layer(request.param("layer"));
  if (!layer) return layer.error();
  key.layer = *layer;
  key.recipe_name = request.param("recipe");
  auto recipe = catalog.recipe(key.recipe_name);
  if (!recipe) return recipe.error();
  key.recipe = **recipe;
  key.seed = key.recipe.seed;
  if (seed_text) {
    auto seed = parse_seed(*seed_text);
    if (!seed) return seed.error();
    key.seed = *seed;
  }
  key.recipe.seed = 0;  // only the default; the seed in force is a part of the key of its own
  return key;
}

Result<TileKey> tile_key_from(const Catalog& catalog, const http::Request& request) {
  std::set<std::string> seen;
  for (const auto& [name, value] : request.target.query) {
    if (!seen.insert(name).second) return Error{ErrorCode::kInvalidArgument, "query key " + name + " was given twice"};
  }
  auto ground = ground_key(catalog, request, request.query("seed"));
  if (!ground) return ground.error();
  TileKey key = std::move(*ground);
  const LayerInfo& info = key.layer->info();
  const bool is_cesium = request.param("ext").empty();
  if (is_cesium && info.grid == GridKind::kNative) {
    return Error{ErrorCode::kInvalidArgument, fmt::format("layer {} has the grid native; CesiumJS needs a layer ingested with --grid "
                                                          "WorldCRS84Quad or WebMercatorQuad",
                                                          info.name)};
  }
  std::string y(request.param("y"));
  if (is_cesium) y = row_from_tms(request.param("z"), y);
  const bool is_root = is_cesium && info.grid == GridKind::kWorldCrs84Quad && request.param("z") == "0" && y == "0" &&
                       (request.param("x") == "0" || request.param("x") == "1");
  if (is_root && !info.has_tile({0, request.param("x") == "1" ? 1 : 0, 0})) {
    key.id = {0, request.param("x") == "1" ? 1 : 0, 0};
    key.mesh.is_flat = true;
  } else {
    auto id = parse_tile_id(info, request.param("z"), request.param("x"), y);
    if (!id) return id.error();
    key.id = *id;
  }
  if (key.id.z > key.layer->info().base_level + key.recipe.depth_limit) {
    return Error{ErrorCode::kNotFound, fmt::format("level {} is deeper than recipe {} goes: {} levels below base level {}", key.id.z,
                                                   key.recipe_name, key.recipe.depth_limit, key.layer->info().base_level)};
  }
  if (auto ok = set_format(key, is_cesium ? "terrain" : request.param("ext"), request.target.query); !ok) return ok.error();
  if (key.format == TileFormat::kTerrain) {
    const TerrainFields fields = terrain_fields(request);
    key.mesh.extensions = fields.extensions;
    key.mesh.is_gzip = fields.is_gzip;
  }
  if (auto ok = check_revision(*key.layer, request); !ok) return ok.error();
  return key;
}

Result<void> check_revision(const Layer& layer, const http::Request& request) {
  const auto v = request.query("v");
  if (!v || *v == layer.revision()) return {};
  const bool is_revision = v->size() == 16 && v->find_first_not_of("0123456789abcdef") == std::string_view::npos;
  if (!is_revision) return Error{ErrorCode::kInvalidArgument, fmt::format("query v={}: must be a revision, 16 hexadecimal digits", *v)};
  return Error{ErrorCode::kGone, fmt::format("revision {} of layer {} is not in force any more; the current one is {}", *v,
                                             layer.info().name, layer.revision())};
}

void add_tile_routes(http::Router& router, App& app) {
  const auto targets = std::make_shared<ResolvedTargets>();
  router.add("GET", "/tiles/{layer}/{recipe}/{z}/{x}/{y}.{ext}",
             [&app, targets](std::shared_ptr<const http::Request> request, http::Responder responder) {
               serve_tile(app, targets, request, std::move(responder));
             });
  router.add("GET", "/cesium/{layer}/{recipe}/{z}/{x}/{y}.terrain",
             [&app, targets](std::shared_ptr<const http::Request> request, http::Responder responder) {
               serve_tile(app, targets, request, std::move(responder));
             });
}

}  // namespace lodestone
