// GET and POST /heights/{layer}/{recipe}: bilinear heights from the very posts of a tile. Statuses: 200, 400, 404, 410, 413, 503.

#include <fmt/format.h>

#include <charconv>
#include <cmath>
#include <cstring>
#include <mutex>

#include "service/app/respond.h"
#include "service/app/routes.h"

namespace lodestone {
namespace {

using nlohmann::ordered_json;
using RequestPtr = std::shared_ptr<const http::Request>;

constexpr std::size_t kMostPoints = 4096;
constexpr std::size_t kMostTiles = 256;  // distinct tiles of one request

struct Point {
  double lon = 0, lat = 0;
  // Filled in by locate(): the tile, the cell's north-west post in it, and the place in the cell.
  bool is_inside = false;
  TileId id;
  int column = 0, row = 0;
  float fx = 0, fy = 0;
};

Result<double> parse_degrees(std::string_view name, std::string_view text, double limit) {
  double value = 0;
  const auto [end, code] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (text.empty() || code != std::errc() || end != text.data() + text.size() || !(std::abs(value) <= limit)) {
    return Error{ErrorCode::kInvalidArgument, fmt::format("query {}={}: must be degrees in -{}..{}", name, text, limit, limit)};
  }
  return value;
}

// Tile and place of every point at level z.
void locate(const Layer& layer, int z, std::vector<Point>& points) {
  const LayerInfo& info = layer.info();
  std::vector<double> x(points.size());
  std::vector<double> y(points.size());
  const auto ok = std::make_unique<bool[]>(points.size());
  for (std::size_t n = 0; n < points.size(); ++n) {
    x[n] = points[n].lon;
    y[n] = points[n].lat;
  }
  layer.crs().layer_from_wgs84(x, y, {ok.get(), points.size()});
  PostWindow world = info.world_at(z);
  if (z < info.base_level) {
    // The data may end between two posts of a coarser level; the post behind its border is in the tile, filled.
    const int up = info.base_level - z;
    world = {floor_shift(info.world.i0, up), floor_shift(info.world.j0, up), ceil_shift(info.world.i1, up), ceil_shift(info.world.j1, up)};
  }
  for (std::size_t n = 0; n < points.size(); ++n) {
    if (!ok[n]) continue;
    const auto post = info.post_from_world(z, x[n], y[n]);
    // A point on the data's border may come back from the projection a hair outside.
    const double slack = 1e-6;
    if (!(post[0] >= world.i0 - slack && post[0] <= world.i1 + slack && post[1] >= world.j0 - slack && post[1] <= world.j1 + slack)) continue;
    const auto cell = [](double p, std::int64_t lo, std::int64_t hi) {
      return std::clamp(static_cast<std::int64_t>(std::floor(p)), lo, std::max(lo, hi - 1));
    };
    const std::int64_t i = cell(post[0], world.i0, world.i1);
    const std::int64_t j = cell(post[1], world.j0, world.j1);
    const std::int64_t cells = info.cells_per_tile();
    Point& point = points[n];
    point.id = {z, floor_shift(i, std::countr_zero(static_cast<std::uint64_t>(cells))),
                floor_shift(j, std::countr_zero(static_cast<std::uint64_t>(cells)))};
    if (!info.has_tile(point.id)) continue;
    point.column = static_cast<int>(i - point.id.x * cells);
    point.row = static_cast<int>(j - point.id.y * cells);
    point.fx = static_cast<float>(std::clamp(post[0] - static_cast<double>(i), 0.0, 1.0));
    point.fy = static_cast<float>(std::clamp(post[1] - static_cast<double>(j), 0.0, 1.0));
    point.is_inside = true;
  }
}

ordered_json point_json(const Point& point, const CachedTile* tile, int posts) {
  ordered_json json{{"lon", point.lon}, {"lat", point.lat}};
  if (tile == nullptr) {
    json["height_m"] = nullptr;
    json["provenance"] = "outside";
    return json;
  }
  const auto at = [&](int column, int row) {
    float value = 0;
    std::memcpy(&value, tile->body.data() + (static_cast<std::size_t>(row) * posts + column) * sizeof value, sizeof value);
    return value;
  };
  const std::size_t count = static_cast<std::size_t>(posts) * posts;
  int provenance = 0;
  for (const int row : {point.row, point.row + 1}) {
    for (const int column : {point.column, point.column + 1}) {
      // A post that takes no part says nothing about the height.
      if ((column > point.column && point.fx == 0) || (row > point.row && point.fy == 0)) continue;
      const int p = static_cast<unsigned char>(tile->body[count * sizeof(float) + static_cast<std::size_t>(row) * posts + column]);
      provenance = p == kFilled ? kFilled : (provenance == kFilled ? kFilled : std::max(provenance, p));
    }
  }
  const float top = at(point.column, point.row) + point.fx * (at(point.column + 1, point.row) - at(point.column, point.row));
  const float bottom = at(point.column, point.row + 1) + point.fx * (at(point.column + 1, point.row + 1) - at(point.column, point.row + 1));
  static constexpr std::string_view words[] = {"surveyed", "filled", "synthetic"};
  json["height_m"] = top + point.fy * (bottom - top);
  json["provenance"] = words[provenance];
  json["tile"] = to_string(point.id);
  return json;
}

// One request's tiles on their way.
struct Gathering {
  std::mutex mutex;  // guards all below
  std::map<TileId, CachedTilePtr> tiles;
  std::optional<Error> error;
  std::size_t missing = 0;
};

// Fetches the points' tiles, then answers with `finish`.
void gather(App& app, const TileKey& base, std::vector<Point> points, const RequestPtr& request, http::Responder responder,
            std::function<ordered_json(const std::vector<Point>&, const std::map<TileId, CachedTilePtr>&)> finish) {
  const auto gathering = std::make_shared<Gathering>();
  for (const Point& point : points) {
    if (point.is_inside) gathering->tiles[point.id] = nullptr;
  }
  const auto shared = std::make_shared<http::Responder>(std::move(responder));
  if (gathering->tiles.empty()) return send_json(*request, *shared, finish(points, {}));
  if (gathering->tiles.size() > kMostTiles) {
    return send_error(*request, *shared, {ErrorCode::kTooLarge, fmt::format("the points lie on {} tiles of this level; at most {} in one request", gathering->tiles.size(), kMostTiles)});
  }
  gathering->missing = gathering->tiles.size();
  std::vector<TileId> ids;
  for (const auto& [id, tile] : gathering->tiles) ids.push_back(id);
  const auto shared_points = std::make_shared<const std::vector<Point>>(std::move(points));
  std::vector<TileService::Ticket> tickets;
  for (const TileId& id : ids) {
    TileKey key = base;
    key.id = id;
    tickets.push_back(app.tiles().get(key, Priority::kInteractive, [&app, gathering, shared, shared_points, request, finish, id](const TileAnswer& answer) {
      {
        const std::lock_guard lock(gathering->mutex);
        if (answer.tile) {
          gathering->tiles[id] = *answer.tile;
        } else if (!gathering->error) {
          gathering->error = answer.tile.error();
        }
        if (--gathering->missing > 0) return;
      }
      if (gathering->error) {
        send_error(*request, *shared, *gathering->error, app.tiles().retry_after_s());
      } else {
        send_json(*request, *shared, finish(*shared_points, gathering->tiles));
      }
    }));
  }
  shared->on_abandoned([&app, tickets] {
    for (const auto ticket : tickets) app.tiles().leave(ticket);
  });
}

// The key but for the tile's address; z from "z" or the base level.
Result<TileKey> height_key(const Catalog& catalog, const http::Request& request, const std::optional<std::string>& z_text,
                           const std::optional<std::string>& seed_text) {
  auto ground = ground_key(catalog, request, seed_text);
  if (!ground) return ground.error();
  TileKey key = std::move(*ground);
  const LayerInfo& info = key.layer->info();
  const int deepest = info.base_level + key.recipe.depth_limit;
  int z = info.base_level;
  if (z_text) {
    const auto [end, code] = std::from_chars(z_text->data(), z_text->data() + z_text->size(), z);
    if (z_text->empty() || code != std::errc() || end != z_text->data() + z_text->size() || z < 0 || z > deepest) {
      return Error{ErrorCode::kInvalidArgument, fmt::format("z={}: must be a level of layer {}, 0..{}", *z_text, info.name, deepest)};
    }
  }
  if (auto ok = check_revision(*key.layer, request); !ok) return ok.error();
  key.id.z = z;
  key.format = TileFormat::kGround;
  return key;
}

ordered_json head_json(const TileKey& key) {
  return {{"layer", key.layer->info().name}, {"recipe", key.recipe_name}, {"seed", key.seed}, {"z", key.id.z}, {"revision", key.layer->revision()},
          {"datum", key.layer->info().datum}};
}

std::optional<std::string> text_of(std::optional<std::string_view> view) {
  return view ? std::optional<std::string>(std::string(*view)) : std::nullopt;
}

void serve_one(App& app, const RequestPtr& request, http::Responder responder) {
  if (auto ok = check_query(*request, {"lon", "lat", "z", "seed", "v"}); !ok) return send_error(*request, responder, ok.error());
  const auto catalog = app.catalog();
  auto key = height_key(*catalog, *request, text_of(request->query("z")), text_of(request->query("seed")));
  if (!key) return send_error(*request, responder, key.error());
  auto lon = parse_degrees("lon", request->query("lon").value_or(""), 180);
  if (!lon) return send_error(*request, responder, lon.error());
  auto lat = parse_degrees("lat", request->query("lat").value_or(""), 90);
  if (!lat) return send_error(*request, responder, lat.error());
  std::vector<Point> points{{*lon, *lat}};
  locate(*key->layer, key->id.z, points);
  if (!points[0].is_inside) {
    const GeoBox& box = key->layer->info().bounds_wgs84;
    return send_error(*request, responder, {ErrorCode::kNotFound, fmt::format("point {}, {} is outside layer {}: {}..{} east, {}..{} north", *lon, *lat,
                                                                             key->layer->info().name, box[0], box[2], box[1], box[3])});
  }
  const int posts = key->layer->info().posts_per_tile;
  gather(app, *key, points, request, std::move(responder), [key = *key, posts](const auto& located, const auto& tiles) {
    ordered_json json = head_json(key);
    json.update(point_json(located[0], tiles.at(located[0].id).get(), posts));
    return json;
  });
}

void serve_many(App& app, const RequestPtr& request, http::Responder responder) {
  if (auto ok = check_query(*request, {"v"}); !ok) return send_error(*request, responder, ok.error());
  const auto bad = [&](const std::string& rule) { send_error(*request, responder, {ErrorCode::kInvalidArgument, rule}); };
  const auto json = nlohmann::json::parse(request->body, nullptr, false);
  if (!json.is_object() || !json.contains("points") || !json["points"].is_array()) {
    return bad("the body must be JSON like {\"points\": [[lon, lat], ...], \"z\": 5, \"seed\": 1}");
  }
  for (const auto& [name, value] : json.items()) {
    if (name != "points" && name != "z" && name != "seed") return bad("unknown key " + name + " in the body; there are: points, z, seed");
    if (name != "points" && !value.is_number_integer()) return bad(name + " in the body must be a whole number");
  }
  if (json["points"].size() > kMostPoints) {
    return send_error(*request, responder, {ErrorCode::kTooLarge, fmt::format("{} points; at most {} in one request", json["points"].size(), kMostPoints)});
  }
  std::vector<Point> points;
  for (const auto& item : json["points"]) {
    if (!item.is_array() || item.size() != 2 || !item[0].is_number() || !item[1].is_number() || std::abs(item[0].get<double>()) > 180 ||
        std::abs(item[1].get<double>()) > 90) {
      return bad(fmt::format("points[{}] must be [lon, lat] in degrees", points.size()));
    }
    points.push_back({item[0], item[1]});
  }
  const auto catalog = app.catalog();
  const auto text = [&](const char* name) { return json.contains(name) ? std::optional<std::string>(json[name].dump()) : std::nullopt; };
  auto key = height_key(*catalog, *request, text("z"), text("seed"));
  if (!key) return send_error(*request, responder, key.error());
  locate(*key->layer, key->id.z, points);
  const int posts = key->layer->info().posts_per_tile;
  gather(app, *key, std::move(points), request, std::move(responder), [key = *key, posts](const auto& located, const auto& tiles) {
    ordered_json out = head_json(key);
    out["points"] = ordered_json::array();
    for (const Point& point : located) {
      out["points"].push_back(point_json(point, point.is_inside ? tiles.at(point.id).get() : nullptr, posts));
    }
    return out;
  });
}

}  // namespace

void add_height_routes(http::Router& router, App& app) {
  router.add("GET", "/heights/{layer}/{recipe}",
             [&app](RequestPtr request, http::Responder responder) { serve_one(app, request, std::move(responder)); });
  router.add("POST", "/heights/{layer}/{recipe}",
             [&app](RequestPtr request, http::Responder responder) { serve_many(app, request, std::move(responder)); },
             {.max_body_bytes = std::size_t{1} << 20});
}

}  // namespace lodestone
