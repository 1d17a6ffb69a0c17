// GET /, /layers, /layers/{layer}, /tiles/{layer}/{recipe}/tilejson.json. Statuses: 200, 400, 404, 410.

#include <fmt/format.h>

#include <cmath>

#include "service/app/respond.h"
#include "service/app/routes.h"
#include "service/http/etag.h"

namespace lodestone {
namespace {

using nlohmann::ordered_json;
using RequestPtr = std::shared_ptr<const http::Request>;

ordered_json layer_json(const Catalog& catalog, const Layer& layer, const std::string& base) {
  const LayerInfo& info = layer.info();
  ordered_json recipes = ordered_json::array();
  for (const auto& [name, recipe] : catalog.recipes) {
    recipes.push_back({{"name", name}, {"method", to_string(recipe.method)}, {"seed", recipe.seed}, {"masks", layer.resolve_masks(recipe.masks)}});
  }
  ordered_json masks = ordered_json::array();
  for (const MaskInfo& mask : layer.mask_list()) {
    masks.push_back({{"name", mask.name}, {"level", mask.level}, {"width", mask.width}, {"height", mask.height}, {"mean", mask.mean}});
  }
  ordered_json spacing = ordered_json::array();
  for (int z = 0; z <= info.max_level(); ++z) {
    spacing.push_back({std::ldexp(std::hypot(info.transform[1], info.transform[4]), info.base_level - z),
                       std::ldexp(std::hypot(info.transform[2], info.transform[5]), info.base_level - z)});
  }
  return {{"name", info.name},
          {"crs", info.crs_name},
          {"crs_wkt", info.crs_wkt},
          {"grid", to_string(info.grid)},
          {"bounds", info.bounds},
          {"bounds_wgs84", info.bounds_wgs84},
          {"transform", info.transform},
          {"posts_per_tile", info.posts_per_tile},
          {"width_posts", info.world.width()},
          {"height_posts", info.world.height()},
          {"first_post", {info.world.i0, info.world.j0}},
          {"base_level", info.base_level},
          {"max_level", info.max_level()},
          {"spacing", spacing},
          {"cell_m", {info.cell_x_m, info.cell_y_m}},
          {"height_min_m", info.height_min_m},
          {"height_max_m", info.height_max_m},
          {"void_posts", info.void_posts},
          {"datum", info.datum},
          {"revision", layer.revision()},
          {"recipes", recipes},
          {"masks", masks},
          {"zones", ordered_json::array()},
          {"imagery", ordered_json::array()},
          {"tiles", base + "/tiles/" + info.name + "/{recipe}/{z}/{x}/{y}.{ext}?v=" + layer.revision()},
          {"heights", base + "/heights/" + info.name + "/{recipe}?lon={lon}&lat={lat}&z={z}"}};
}

std::string html_escaped(std::string_view text) {
  std::string out;
  for (const char c : text) {
    switch (c) {
      case '&':
        out += "&amp;";
        break;
      case '<':
        out += "&lt;";
        break;
      case '>':
        out += "&gt;";
        break;
      case '"':
        out += "&quot;";
        break;
      default:
        out += c;
    }
  }
  return out;
}

std::string landing_html(const Catalog& catalog) {
  std::string body;
  for (const auto& [name, layer] : catalog.layers) {
    const LayerInfo& info = layer->info();
    const std::string n = html_escaped(name);
    // A picture of the level that shows the whole layer in few tiles: the root.
    body += fmt::format(
        "<section><a href=\"/tiles/{0}/lsa/0/0/0.png?encoding=relief\"><img src=\"/tiles/{0}/lsa/0/0/0.png?encoding=relief\" "
        "width=256 height=256 alt=\"relief of {0}\"></a><div><h2>{0}</h2><p>{1}, grid {2}, {3} x {4} posts, {5:.0f} to {6:.0f} m, "
        "levels 0 to {7} (base {8})</p><p><a href=\"/layers/{0}\">description</a> "
        "<a href=\"/tiles/{0}/lsa/{8}/0/0.exr\">a tile as EXR</a> "
        "<a href=\"/tiles/{0}/lsa/tilejson.json\">TileJSON</a></p><p>recipes:",
        n, html_escaped(info.crs_name), to_string(info.grid), info.world.width(), info.world.height(), info.height_min_m,
        info.height_max_m, info.max_level(), info.base_level);
    for (const auto& [recipe, value] : catalog.recipes) body += " " + html_escaped(recipe);
    body += "</p></div></section>\n";
  }
  if (catalog.layers.empty()) body = "<p>No layers yet: <code>lodestone ingest FILE --layer NAME</code>, then reload.</p>";
  return "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><title>Lodestone</title>"
         "<meta name=\"viewport\" content=\"width=device-width\"><style>body{font:16px/1.5 system-ui,sans-serif;margin:2rem auto;"
         "max-width:60rem;padding:0 1rem;color:#222}section{display:flex;gap:1.5rem;margin:1.5rem 0;flex-wrap:wrap}"
         "img{background:#ddd;border-radius:4px}h2{margin:0}</style><h1>Lodestone</h1>"
         "<p>Real ground, with synthetic detail below it. <a href=\"/viewer/\">viewer</a> <a href=\"/layers\">layers</a> <a href=\"/openapi.json\">API</a> "
         "<a href=\"/metrics\">metrics</a></p>\n" +
         body + "</html>\n";
}

bool wants_html(const http::Request& request) {
  const auto accept = request.joined_header("Accept");
  if (!accept) return false;
  const auto html = accept->find("text/html");
  const auto json = accept->find("application/json");
  return html != std::string::npos && (json == std::string::npos || html < json);
}

void serve_root(App& app, const RequestPtr& request, http::Responder responder) {
  if (auto ok = check_query(*request, {}); !ok) return send_error(*request, responder, ok.error());
  const auto catalog = app.catalog();
  if (wants_html(*request)) {
    http::Response response = http::text_response("text/html; charset=utf-8", landing_html(*catalog));
    response.set("Content-Security-Policy", "default-src 'self'; style-src 'unsafe-inline'").set("Vary", "Accept");
    return send_text(*request, responder, std::move(response));
  }
  const std::string base = base_url(*request);
  ordered_json layers = ordered_json::array();
  for (const auto& [name, layer] : catalog->layers) layers.push_back({{"name", name}, {"href", base + "/layers/" + name}});
  const ordered_json links = ordered_json::array({{{"rel", "service-desc"}, {"href", base + "/openapi.json"}},
                                                  {{"rel", "data"}, {"href", base + "/layers"}},
                                                  {{"rel", "status"}, {"href", base + "/healthz"}}});
  send_json(*request, responder, {{"title", "Lodestone"}, {"layers", layers}, {"links", links}});
}

void serve_tilejson(App& app, const RequestPtr& request, http::Responder responder) {
  if (auto ok = check_query(*request, {"encoding", "seed", "v"}); !ok) return send_error(*request, responder, ok.error());
  const auto catalog = app.catalog();
  auto layer = catalog->layer(request->param("layer"));
  if (!layer) return send_error(*request, responder, layer.error());
  auto recipe = catalog->recipe(request->param("recipe"));
  if (!recipe) return send_error(*request, responder, recipe.error());
  if (auto ok = check_revision(**layer, *request); !ok) return send_error(*request, responder, ok.error());
  const std::string encoding(request->query("encoding").value_or("terrarium"));
  if (encoding != "terrarium" && encoding != "mapbox") {
    return send_error(*request, responder, {ErrorCode::kInvalidArgument, "query encoding=" + encoding + ": must be terrarium or mapbox"});
  }
  std::string extra = "&encoding=" + encoding;
  if (const auto seed = request->query("seed")) {
    auto parsed = parse_seed(*seed);
    if (!parsed) return send_error(*request, responder, parsed.error());
    extra += "&seed=" + std::to_string(*parsed);
  }
  const LayerInfo& info = (*layer)->info();
  std::string description = fmt::format("{} heights of {}, recipe {}", encoding, info.name, request->param("recipe"));
  if (info.grid != GridKind::kWebMercatorQuad) {
    description += fmt::format(". These tiles are on the layer's own grid ({}), not on WebMercatorQuad: map clients need a layer "
                               "ingested with --grid WebMercatorQuad",
                               to_string(info.grid));
  }
  const std::string url = fmt::format("{}/tiles/{}/{}/{{z}}/{{x}}/{{y}}.png?v={}{}", base_url(*request), info.name,
                                      request->param("recipe"), (*layer)->revision(), extra);
  send_json(*request, responder,
            {{"tilejson", "3.0.0"},
             {"name", info.name},
             {"description", description},
             {"scheme", "xyz"},
             {"tiles", {url}},
             {"encoding", encoding},
             {"tileSize", info.cells_per_tile()},
             {"minzoom", 0},
             {"maxzoom", std::min(30, info.max_level())},
             {"bounds", info.bounds_wgs84},
             {"center", {(info.bounds_wgs84[0] + info.bounds_wgs84[2]) / 2, (info.bounds_wgs84[1] + info.bounds_wgs84[3]) / 2,
                         std::min(30, info.base_level)}},
             {"grid", to_string(info.grid)},
             {"crs", info.crs_name},
             {"vector_layers", ordered_json::array()}});
}

}  // namespace

void add_layer_routes(http::Router& router, App& app) {
  router.add("GET", "/", [&app](RequestPtr request, http::Responder responder) { serve_root(app, request, std::move(responder)); });
  router.add("GET", "/layers", [&app](RequestPtr request, http::Responder responder) {
    if (auto ok = check_query(*request, {}); !ok) return send_error(*request, responder, ok.error());
    const auto catalog = app.catalog();
    ordered_json layers = ordered_json::array();
    for (const auto& [name, layer] : catalog->layers) layers.push_back(layer_json(*catalog, *layer, base_url(*request)));
    send_json(*request, responder, {{"layers", layers}});
  });
  router.add("GET", "/layers/{layer}", [&app](RequestPtr request, http::Responder responder) {
    if (auto ok = check_query(*request, {}); !ok) return send_error(*request, responder, ok.error());
    const auto catalog = app.catalog();
    auto layer = catalog->layer(request->param("layer"));
    if (!layer) return send_error(*request, responder, layer.error());
    send_json(*request, responder, layer_json(*catalog, **layer, base_url(*request)));
  });
  router.add("GET", "/tiles/{layer}/{recipe}/tilejson.json",
             [&app](RequestPtr request, http::Responder responder) { serve_tilejson(app, request, std::move(responder)); });
}

}  // namespace lodestone
