// Admin listener: masks, purge, reload. Every route needs the token: 401 without.

#include <fmt/format.h>
#include <spdlog/spdlog.h>

#include "service/app/respond.h"
#include "service/app/routes.h"

namespace lodestone {
namespace {

using RequestPtr = std::shared_ptr<const http::Request>;
using nlohmann::ordered_json;

// Equal in time that does not depend on where they differ.
bool is_same_secret(std::string_view a, std::string_view b) {
  unsigned difference = a.size() == b.size() ? 0 : 1;
  for (std::size_t n = 0; n < a.size(); ++n) difference |= static_cast<unsigned char>(a[n]) ^ static_cast<unsigned char>(b.empty() ? 0 : b[n % b.size()]);
  return difference == 0;
}

ordered_json mask_json(const MaskInfo& mask, const std::string& revision) {
  return {{"name", mask.name}, {"level", mask.level}, {"width", mask.width}, {"height", mask.height}, {"mean", mask.mean}, {"revision", revision}};
}

// Runs on the admin thread: changes a mask, publishes the layer's new revision.
void put_mask(App& app, const http::Request& request, http::Responder& responder) {
  const std::string name(request.param("name"));
  auto layer = app.catalog()->layer(request.param("layer"));
  if (!layer) return send_error(request, responder, layer.error());
  if (auto ok = check_name("mask", name); !ok) return send_error(request, responder, ok.error());
  const auto* bytes = reinterpret_cast<const std::uint8_t*>(request.body.data());
  auto info = (*layer)->masks().put(name, {bytes, request.body.size()});
  if (!info) {
    // What was sent is at fault, not the address: 422.
    const ErrorCode code = info.error().code;
    if (code == ErrorCode::kCorrupt || code == ErrorCode::kUnsupported) {
      return responder.send(http::problem_response(422, info.error().message, request.raw_target, "unprocessable"));
    }
    return send_error(request, responder, info.error());
  }
  if (auto ok = app.catalog_keeper().reload_layer((*layer)->info().name); !ok) return send_error(request, responder, ok.error());
  const auto fresh = app.catalog()->layer(request.param("layer"));
  spdlog::info("event=mask_put layer={} mask={} revision={}", (*layer)->info().name, name, (*fresh)->revision());
  send_json(request, responder, mask_json(*info, (*fresh)->revision()), 201);
}

void get_mask(App& app, const http::Request& request, http::Responder& responder) {
  auto layer = app.catalog()->layer(request.param("layer"));
  if (!layer) return send_error(request, responder, layer.error());
  const std::string format(request.query("format").value_or("png"));
  if (format != "png" && format != "tif") {
    return send_error(request, responder, {ErrorCode::kInvalidArgument, "query format=" + format + ": must be png or tif"});
  }
  auto bytes = (*layer)->masks().get(std::string(request.param("name")), format);
  if (!bytes) return send_error(request, responder, bytes.error());
  responder.send(http::text_response(format == "png" ? "image/png" : "image/tiff", std::move(*bytes)));
}

void delete_mask(App& app, const http::Request& request, http::Responder& responder) {
  auto layer = app.catalog()->layer(request.param("layer"));
  if (!layer) return send_error(request, responder, layer.error());
  if (auto ok = (*layer)->masks().remove(std::string(request.param("name"))); !ok) return send_error(request, responder, ok.error());
  if (auto ok = app.catalog_keeper().reload_layer((*layer)->info().name); !ok) return send_error(request, responder, ok.error());
  spdlog::info("event=mask_removed layer={} mask={}", (*layer)->info().name, request.param("name"));
  http::Response response;
  response.status = 204;
  responder.send(std::move(response));
}

void purge(App& app, const http::Request& request, http::Responder& responder) {
  if (auto ok = check_query(request, {"layer", "recipe"}); !ok) return send_error(request, responder, ok.error());
  const auto layer = request.query("layer");
  const auto recipe = request.query("recipe");
  if (recipe && !layer) return send_error(request, responder, {ErrorCode::kInvalidArgument, "query recipe needs layer beside it"});
  std::string tag(layer.value_or(""));
  if (recipe) tag += "/" + std::string(*recipe);
  auto removed = app.tiles().purge(tag);
  if (!removed) return send_error(request, responder, removed.error());
  spdlog::info("event=purged tag=\"{}\" removed={}", tag, *removed);
  send_json(request, responder, {{"purged", tag.empty() ? "all" : tag}, {"removed_on_disk", *removed}});
}

void reload(App& app, const http::Request& request, http::Responder& responder) {
  if (auto ok = app.reload(); !ok) return send_error(request, responder, ok.error());
  const auto catalog = app.catalog();
  ordered_json layers = ordered_json::object();
  for (const auto& [name, layer] : catalog->layers) layers[name] = layer->revision();
  send_json(request, responder, {{"layers", layers}, {"problems", catalog->problems}});
}

// A handler on the admin thread, behind the token.
http::Handler guarded(App& app, void (*run)(App&, const http::Request&, http::Responder&)) {
  return with_token(app, [&app, run](RequestPtr request, http::Responder responder) {
    const auto shared = std::make_shared<http::Responder>(std::move(responder));
    app.run_later([&app, run, request, shared] { run(app, *request, *shared); });
  });
}

}  // namespace

http::Handler with_token(const App& app, http::Handler handler) {
  return [&app, handler = std::move(handler)](RequestPtr request, http::Responder responder) {
    const std::string& token = app.options().admin_token;
    const auto given = request->header("Authorization");
    const std::string_view scheme = "Bearer ";
    const bool is_bearer = given && given->substr(0, scheme.size()) == scheme;
    const std::string_view secret = is_bearer ? given->substr(scheme.size()) : std::string_view();
    const bool is_same = is_same_secret(secret, token);
    if (token.empty() || !is_same) {
      http::Response response = http::problem_response(
          401, token.empty() ? "no admin token is set: start the daemon with LODESTONE_ADMIN_TOKEN in its environment"
                             : "this route needs the header Authorization: Bearer TOKEN with the token of LODESTONE_ADMIN_TOKEN",
          request->raw_target, "unauthorized");
      response.set("WWW-Authenticate", "Bearer realm=\"lodestone admin\"");
      return responder.send(std::move(response));
    }
    handler(std::move(request), std::move(responder));
  };
}

void add_mask_routes(http::Router& router, App& app) {
  const std::size_t most_bytes = static_cast<std::size_t>(app.options().max_upload_mib) << 20;
  router.add("PUT", "/layers/{layer}/masks/{name}", guarded(app, put_mask), {.max_body_bytes = most_bytes});
  router.add("GET", "/layers/{layer}/masks/{name}", guarded(app, get_mask));
  router.add("DELETE", "/layers/{layer}/masks/{name}", guarded(app, delete_mask));
}

void add_admin_routes(http::Router& router, App& app) {
  router.add("POST", "/purge", guarded(app, purge));
  router.add("POST", "/reload", guarded(app, reload));
}

http::Router public_routes(App& app) {
  http::Router router;
  add_layer_routes(router, app);
  add_tile_routes(router, app);
  add_terrain_routes(router, app);
  add_height_routes(router, app);
  add_view_routes(router, app);
  add_viewer_routes(router, app);
  add_health_routes(router, app);
  return router;
}

http::Router admin_routes(App& app) {
  http::Router router;
  add_mask_routes(router, app);
  add_admin_routes(router, app);
  add_health_routes(router, app);
  return router;
}

}  // namespace lodestone
