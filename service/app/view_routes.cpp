// POST /view/{layer}/{recipe}: cameras in, tiles to draw out. Statuses: 200, 400, 404, 413, 503.

#include <fmt/format.h>

#include <chrono>
#include <cmath>

#include "service/app/respond.h"
#include "service/app/routes.h"
#include "service/view/view_selection.h"

namespace lodestone {
namespace {

using nlohmann::json;
using nlohmann::ordered_json;
using RequestPtr = std::shared_ptr<const http::Request>;

constexpr std::size_t kMostCameras = 256;
constexpr std::size_t kMostPrefetched = 256;  // tiles of one request, nearest first

struct ViewRequest {
  std::vector<Camera> cameras;
  std::vector<ViewOptions> options;
  bool is_path = false;
  bool has_prefetch = false;
  std::uint64_t seed = 0;
};

Error bad(const std::string& field, const std::string& rule) { return {ErrorCode::kInvalidArgument, field + ": " + rule}; }

Result<double> number(const json& body, const std::string& where, const char* name, double standard, double least, double most) {
  if (!body.contains(name)) return standard;
  const json& value = body[name];
  const double v = value.is_number() ? value.get<double>() : NAN;
  if (!(v >= least && v <= most)) return bad(where + name, fmt::format("must be a number in {}..{}", least, most));
  return v;
}

Result<bool> flag(const json& body, const std::string& where, const char* name, bool standard) {
  if (!body.contains(name)) return standard;
  if (!body[name].is_boolean()) return bad(where + name, "must be true or false");
  return body[name].get<bool>();
}

Result<Vec3> triple(const json& body, const std::string& where, const char* name, const std::string& meaning) {
  const json value = body.value(name, json());
  Vec3 out{};
  bool is_good = value.is_array() && value.size() == 3;
  for (std::size_t n = 0; is_good && n < 3; ++n) {
    is_good = value[n].is_number() && std::abs(value[n].get<double>()) <= 1e9;
    if (is_good) out[n] = value[n].get<double>();
  }
  if (!is_good) return bad(where + name, "must be three finite numbers, " + meaning);
  return out;
}

Result<void> check_keys(const json& body, const std::string& where, std::initializer_list<std::string_view> allowed) {
  for (const auto& [name, value] : body.items()) {
    if (std::find(allowed.begin(), allowed.end(), name) != allowed.end()) continue;
    std::string list;
    for (const std::string_view key : allowed) list += (list.empty() ? "" : ", ") + std::string(key);
    return bad(where + name, "unknown key; there are: " + list);
  }
  return {};
}

// Longitude and latitude of a point to the layer's coordinates.
Result<Vec3> layer_point(const Layer& layer, bool is_layer_crs, const std::string& field, Vec3 p) {
  if (is_layer_crs) return p;
  if (std::abs(p[0]) > 360 || std::abs(p[1]) > 90) return bad(field, "must be longitude, latitude in degrees and height in metres");
  std::array<double, 1> x{p[0]}, y{p[1]};
  std::array<bool, 1> ok{};
  layer.crs().layer_from_wgs84(x, y, ok);
  if (!ok[0] || !std::isfinite(x[0]) || !std::isfinite(y[0])) return bad(field, "has no counterpart in the layer's CRS, " + layer.info().crs_name);
  return Vec3{x[0], y[0], p[2]};
}

Result<void> add_camera(const Layer& layer, const json& body, const std::string& where, ViewRequest& request) {
  const json& crs = body.contains("crs") ? body["crs"] : json("lonlat");
  if (crs != "lonlat" && crs != "layer") return bad(where + "crs", "must be \"lonlat\" or \"layer\"");
  const bool is_layer_crs = crs == "layer";
  const std::string meaning = is_layer_crs ? "x and y in the layer's CRS and a height in metres" : "longitude, latitude and a height in metres";
  CameraPlace place;
  auto eye = triple(body, where, "eye", meaning);
  if (!eye) return eye.error();
  auto eye_place = layer_point(layer, is_layer_crs, where + "eye", *eye);
  if (!eye_place) return eye_place.error();
  place.eye = *eye_place;
  place.has_target = body.contains("target");
  if (place.has_target == body.contains("direction")) return bad(where + "target", "give either target or direction");
  auto look = place.has_target ? triple(body, where, "target", meaning) : triple(body, where, "direction", "metres east, north and up");
  if (!look) return look.error();
  place.look = *look;
  if (place.has_target) {
    auto target = layer_point(layer, is_layer_crs, where + "target", *look);
    if (!target) return target.error();
    place.look = *target;
  }
  auto camera = camera_from_world(layer, place);
  if (!camera) return Error{camera.error().code, where + camera.error().message};

  auto fov = number(body, where, "fov_y_deg", 60, 1, 170);
  if (!fov) return fov.error();
  camera->fov_y_rad = *fov * 0.017453292519943295;
  if (body.contains("viewport")) {
    const json& viewport = body["viewport"];
    bool is_good = viewport.is_array() && viewport.size() == 2;
    for (std::size_t n = 0; is_good && n < 2; ++n) is_good = viewport[n].is_number() && viewport[n].get<double>() >= 1 && viewport[n].get<double>() <= 32768;
    if (!is_good) return bad(where + "viewport", "must be [width, height] in pixels, 1..32768");
    camera->width_px = viewport[0];
    camera->height_px = viewport[1];
  }
  ViewOptions options;
  auto error_px = number(body, where, "max_error_px", 2, 0.1, 1000);
  if (!error_px) return error_px.error();
  options.max_error_px = *error_px;
  auto iterations = number(body, where, "max_iterations", kMaxDepth, 0, kMaxDepth);
  if (!iterations) return iterations.error();
  options.max_iterations = static_cast<int>(*iterations);
  auto balanced = flag(body, where, "balanced", true);
  if (!balanced) return balanced.error();
  options.is_balanced = *balanced;
  request.cameras.push_back(*camera);
  request.options.push_back(options);
  return {};
}

Result<ViewRequest> parse(const Layer& layer, const Recipe& recipe, const std::string& text) {
  const json body = json::parse(text, nullptr, false);
  if (!body.is_object()) {
    return Error{ErrorCode::kInvalidArgument, "the body must be a JSON object like {\"eye\": [lon, lat, height_m], \"target\": [lon, lat, height_m]}; NaN and Infinity are not JSON"};
  }
  ViewRequest request;
  request.seed = recipe.seed;
  if (auto ok = check_keys(body, "", {"eye", "target", "direction", "crs", "fov_y_deg", "viewport", "max_error_px", "max_iterations", "seed", "balanced", "prefetch", "path"}); !ok) return ok.error();
  if (body.contains("seed")) {
    if (!body["seed"].is_number_unsigned()) return bad("seed", "must be a whole number, 0..18446744073709551615");
    request.seed = body["seed"];
  }
  auto prefetch = flag(body, "", "prefetch", false);
  if (!prefetch) return prefetch.error();
  request.has_prefetch = *prefetch;
  request.is_path = body.contains("path");
  if (!request.is_path) {
    if (auto ok = add_camera(layer, body, "", request); !ok) return ok.error();
    return request;
  }
  const json& path = body["path"];
  if (!path.is_array() || path.empty() || path.size() > kMostCameras) return bad("path", fmt::format("must be a list of 1..{} cameras", kMostCameras));
  for (std::size_t n = 0; n < path.size(); ++n) {
    const std::string where = fmt::format("path[{}].", n);
    if (!path[n].is_object()) return bad(fmt::format("path[{}]", n), "must be a camera");
    if (auto ok = check_keys(path[n], where, {"eye", "target", "direction", "crs", "fov_y_deg", "viewport", "max_error_px", "max_iterations", "balanced"}); !ok) return ok.error();
    json camera = body;  // what a camera leaves out is that of the whole request
    if (path[n].contains("target")) camera.erase("direction");
    if (path[n].contains("direction")) camera.erase("target");
    camera.update(path[n]);
    if (auto ok = add_camera(layer, camera, where, request); !ok) return ok.error();
  }
  return request;
}

ordered_json answer_json(const ViewAnswer& answer) {
  ordered_json tiles = ordered_json::array();
  for (const ViewTile& tile : answer.tiles) {
    // Where the eye may be inside the tile's ground there is no distance to divide by: null.
    tiles.push_back({{"z", tile.id.z}, {"x", tile.id.x}, {"y", tile.id.y}, {"distance_m", tile.distance_m},
                     {"error_px", std::isfinite(tile.error_px) ? ordered_json(tile.error_px) : ordered_json()}, {"iterations", tile.iterations}});
  }
  return {{"tiles", std::move(tiles)}, {"culled", {{"frustum", answer.culled_frustum}, {"facing", answer.culled_facing}}}, {"visible_ground_m2", answer.visible_ground_m2}};
}

void prefetch(App& app, TileKey key, const ViewAnswer& answer) {
  key.format = TileFormat::kF32;
  for (std::size_t n = 0; n < std::min(answer.tiles.size(), kMostPrefetched); ++n) {
    key.id = answer.tiles[n].id;
    app.tiles().get(key, Priority::kPrefetch, [](const TileAnswer&) {});
  }
}

void serve_view(App& app, const std::shared_ptr<HeightBoundsCache>& cache, const RequestPtr& request, http::Responder responder) {
  if (auto ok = check_query(*request, {"v"}); !ok) return send_error(*request, responder, ok.error());
  const auto catalog = app.catalog();
  auto layer = catalog->layer(request->param("layer"));
  if (!layer) return send_error(*request, responder, layer.error());
  auto recipe = catalog->recipe(request->param("recipe"));
  if (!recipe) return send_error(*request, responder, recipe.error());
  if (const auto v = request->query("v"); v && *v != (*layer)->revision()) {
    return send_error(*request, responder, {ErrorCode::kGone, fmt::format("revision {} of layer {} is not in force any more; the current one is {}", *v, (*layer)->info().name, (*layer)->revision())});
  }
  TileKey key;
  key.layer = *layer;
  key.recipe_name = request->param("recipe");
  key.recipe = **recipe;
  const auto shared = std::make_shared<http::Responder>(std::move(responder));
  app.tiles().post([&app, cache, request, shared, key = std::move(key)](TileMaker&) mutable {
    const auto start = std::chrono::steady_clock::now();
    auto view = parse(*key.layer, key.recipe, request->body);
    if (!view) return send_error(*request, *shared, view.error());
    key.seed = view->seed;
    const auto bounds = cache->of(key.layer);
    const Recipe recipe = key.recipe;
    key.recipe.seed = 0;
    ordered_json out = ordered_json::array();
    for (std::size_t n = 0; n < view->cameras.size(); ++n) {
      auto answer = select_view(*bounds, recipe, view->cameras[n], view->options[n]);
      if (!answer) {
        const std::string where = view->is_path ? fmt::format("path[{}].", n) : "";
        return send_error(*request, *shared, {answer.error().code, where + answer.error().message});
      }
      if (view->has_prefetch) prefetch(app, key, *answer);
      out.push_back(answer_json(*answer));
    }
    const double ms = std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - start).count();
    http::Response response = http::text_response("application/json", (view->is_path ? out : out[0]).dump());
    response.set("Cache-Control", "no-cache").set("Server-Timing", fmt::format("view;dur={:.3f}", ms));
    send_text(*request, *shared, std::move(response));
  });
}

}  // namespace

void add_view_routes(http::Router& router, App& app) {
  const auto cache = std::make_shared<HeightBoundsCache>();
  router.add("POST", "/view/{layer}/{recipe}",
             [&app, cache](RequestPtr request, http::Responder responder) { serve_view(app, cache, request, std::move(responder)); },
             {.max_body_bytes = std::size_t{64} << 10});
}

}  // namespace lodestone
