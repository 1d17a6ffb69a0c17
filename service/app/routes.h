#pragma once
// The routes by topic; public_routes() and admin_routes() in app.h put them together.

#include "service/app/app.h"
#include "service/http/router.h"

namespace lodestone {

void add_tile_routes(http::Router& router, App& app);    // /tiles/..., /cesium/...
void add_terrain_routes(http::Router& router, App& app); // /tiles/.../layer.json
void add_layer_routes(http::Router& router, App& app);   // /, /layers, tilejson.json
void add_height_routes(http::Router& router, App& app);  // /heights/...
void add_view_routes(http::Router& router, App& app);    // /view/...
void add_viewer_routes(http::Router& router, App& app);  // /viewer/
void add_health_routes(http::Router& router, App& app);  // /healthz, /readyz, /metrics, /openapi.json
void add_mask_routes(http::Router& router, App& app);    // admin: masks
void add_admin_routes(http::Router& router, App& app);   // admin: purge, reload

// Wraps a handler of the admin listener: 401 without `Authorization: Bearer <LODESTONE_ADMIN_TOKEN>`.
http::Handler with_token(const App& app, http::Handler handler);

// The key of a tile request: layer, recipe, seed, revision, address (TMS rows without an "ext" parameter), format; for
// .terrain also what Accept and Accept-Encoding say. Errors: kNotFound, kInvalidArgument, kGone.
Result<TileKey> tile_key_from(const Catalog& catalog, const http::Request& request);

// Layer, recipe and seed of a request's key: path parameters, and the seed's text where one is given. Errors: kNotFound,
// kInvalidArgument.
Result<TileKey> ground_key(const Catalog& catalog, const http::Request& request, std::optional<std::string_view> seed_text);

// The query's ?v= against the layer's revision. Errors: kInvalidArgument (not a revision), kGone (another one).
Result<void> check_revision(const Layer& layer, const http::Request& request);

}  // namespace lodestone
