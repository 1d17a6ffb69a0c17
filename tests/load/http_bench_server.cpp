// A server with tiles of 4, 64 and 264 KiB in memory, for tests/load/http_bench.py. Prints its port; ends with its standard input.

#include <cstdio>
#include <string>

#include "service/http/etag.h"
#include "service/http/server.h"

int main() {
  using namespace lodestone::http;
  Router router;
  for (const int kib : {4, 64, 264}) {
    const auto bytes = std::make_shared<const std::string>(static_cast<std::size_t>(kib) * 1024, 't');
    const std::string etag = strong_etag("tile-" + std::to_string(kib));
    router.add("GET", "/" + std::to_string(kib) + "/{z}/{x}/{y}.{ext}", [bytes, etag](const std::shared_ptr<const Request>& request, Responder responder) {
      Response response;
      response.set("ETag", etag).set("Cache-Control", "public, max-age=3600");
      if (const auto field = request->joined_header("If-None-Match"); field && none_match_names(*field, etag)) {
        response.status = 304;
      } else {
        response.content_type = "application/octet-stream";
        response.body = Body::shared(bytes);
      }
      responder.send(std::move(response));
    });
  }
  Server server(std::move(router), {});
  auto port = server.listen("127.0.0.1:0");
  if (!port) {
    std::fprintf(stderr, "%s\n", port.error().message.c_str());
    return 1;
  }
  server.start();
  std::printf("%d\n", *port);
  std::fflush(stdout);
  while (std::getchar() != EOF) {
  }
  server.stop(std::chrono::milliseconds(1000));
  return server.wait() ? 0 : 1;
}
