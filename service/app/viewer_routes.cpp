// GET /viewer/: the 3-D page and its files, from the program itself. Statuses: 200, 400, 404.

#include "cmake/embed.h"
#include "service/app/respond.h"
#include "service/app/routes.h"

namespace lodestone {

extern const EmbeddedFile viewer_files[];
extern const std::size_t viewer_files_count;

void add_viewer_routes(http::Router& router, App&) {
  router.add("GET", "/viewer/{path...}", [](std::shared_ptr<const http::Request> request, http::Responder responder) {
    const std::string path(request->param("path"));
    const std::string name = "service/viewer/" + (path.empty() ? "index.html" : path);
    for (std::size_t n = 0; n < viewer_files_count; ++n) {
      if (viewer_files[n].name != name) continue;
      const std::string type = name.ends_with(".html") ? "text/html; charset=utf-8" : name.ends_with(".css") ? "text/css; charset=utf-8"
                               : name.ends_with(".js") ? "text/javascript; charset=utf-8" : "text/plain; charset=utf-8";
      http::Response response = http::text_response(type, std::string(viewer_files[n].text));
      response.set("Content-Security-Policy", "default-src 'self'").set("Cache-Control", "no-cache");
      return send_text(*request, responder, std::move(response));
    }
    send_error(*request, responder, {ErrorCode::kNotFound, "there is no viewer file " + http::safe_echo(path) + "; the page is /viewer/"});
  });
}

}  // namespace lodestone
