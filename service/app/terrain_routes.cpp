// GET /tiles/{layer}/{recipe}/layer.json: what CesiumJS reads first. Statuses: 200, 400, 404, 410.

#include <fmt/format.h>

#include "service/app/respond.h"
#include "service/app/routes.h"

namespace lodestone {
namespace {

using nlohmann::ordered_json;
using RequestPtr = std::shared_ptr<const http::Request>;

// Rectangles of tiles that are answered, one list per level; rows from the south.
ordered_json available_json(const LayerInfo& info, int deepest) {
  ordered_json levels = ordered_json::array();
  for (int z = 0; z <= deepest; ++z) {
    const std::int64_t rows = std::int64_t{1} << z;
    PostWindow tiles = info.tiles_at(z);
    // Both hemispheres have a root tile, flat where there is no data.
    if (z == 0 && info.grid == GridKind::kWorldCrs84Quad) tiles = {0, 0, 1, 0};
    levels.push_back({{{"startX", tiles.i0}, {"startY", rows - 1 - tiles.j1}, {"endX", tiles.i1}, {"endY", rows - 1 - tiles.j0}}});
  }
  return levels;
}

void serve_layer_json(App& app, const RequestPtr& request, http::Responder responder) {
  if (auto ok = check_query(*request, {"seed", "error", "v"}); !ok) return send_error(*request, responder, ok.error());
  const auto catalog = app.catalog();
  auto layer = catalog->layer(request->param("layer"));
  if (!layer) return send_error(*request, responder, layer.error());
  auto recipe = catalog->recipe(request->param("recipe"));
  if (!recipe) return send_error(*request, responder, recipe.error());
  const LayerInfo& info = (*layer)->info();
  if (info.grid == GridKind::kNative) {
    return send_error(*request, responder,
                      {ErrorCode::kInvalidArgument, fmt::format("layer {} has the grid native; CesiumJS needs a layer ingested with --grid "
                                                                "WorldCRS84Quad or WebMercatorQuad",
                                                                info.name)});
  }
  if (auto ok = check_revision(**layer, *request); !ok) return send_error(*request, responder, ok.error());
  std::string extra;
  if (const auto seed = request->query("seed")) {
    auto parsed = parse_seed(*seed);
    if (!parsed) return send_error(*request, responder, parsed.error());
    extra += "&seed=" + std::to_string(*parsed);
  }
  if (const auto error = request->query("error")) {
    MeshOptions options;
    if (auto ok = set_mesh_option(options, "error", std::string(*error)); !ok) return send_error(*request, responder, ok.error());
    extra += fmt::format("&error={}", *options.error_m);
  }
  const int deepest = std::min(info.max_level(), info.base_level + (*recipe)->depth_limit);
  const bool is_geographic = info.grid == GridKind::kWorldCrs84Quad;
  send_json(*request, responder,
            {{"tilejson", "2.1.0"},
             {"name", info.name},
             {"description", fmt::format("{}, recipe {}; heights above {}", info.name, request->param("recipe"), info.datum)},
             {"version", (*layer)->revision()},
             {"format", "quantized-mesh-1.0"},
             {"scheme", "tms"},
             {"projection", is_geographic ? "EPSG:4326" : "EPSG:3857"},
             {"bounds", info.bounds_wgs84},
             {"minzoom", 0},
             {"maxzoom", deepest},
             {"extensions", {"octvertexnormals", "watermask", "metadata"}},
             {"tiles", {fmt::format("{}/cesium/{}/{}/{{z}}/{{x}}/{{y}}.terrain?v={}{}", base_url(*request), info.name, request->param("recipe"),
                                    (*layer)->revision(), extra)}},
             {"available", available_json(info, deepest)}});
}

}  // namespace

void add_terrain_routes(http::Router& router, App& app) {
  router.add("GET", "/tiles/{layer}/{recipe}/layer.json",
             [&app](RequestPtr request, http::Responder responder) { serve_layer_json(app, request, std::move(responder)); });
}

}  // namespace lodestone
