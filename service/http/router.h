#pragma once
// Router: method and path to handler.

#include <cstddef>
#include <functional>
#include <memory>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "service/http/message.h"
#include "service/http/responder.h"

namespace lodestone::http {

// Runs on the server's io thread: answers at once from memory, or hands the Responder to a worker. Must not block.
using Handler = std::function<void(std::shared_ptr<const Request>, Responder)>;

struct RouteOptions {
  std::size_t max_body_bytes = 0;  // a larger body is refused with 413 before it is read
};

// A route as registered; the OpenAPI document is checked against these.
struct RouteInfo {
  std::string method;
  std::string pattern;
};

class Router {
 public:
  // method: GET, POST, PUT, PATCH or DELETE; GET also serves HEAD.
  // pattern: "/" or "/"-separated segments, each one of
  //   text            that text              "{name}"    any non-empty segment
  //   "{y}.terrain"   split at the last dot  "{y}.{ext}" likewise, both parts non-empty
  //   "{path...}"     last only: the rest, joined with '/', perhaps empty
  // Text beats parameters, segment by segment from the left. The same method and pattern twice is a bug (assert).
  void add(std::string_view method, std::string_view pattern, Handler handler, RouteOptions options = {});
  std::vector<RouteInfo> routes() const;

  struct Match {
    const Handler* handler = nullptr;  // nullptr: see is_path_known
    std::string_view pattern;
    RouteOptions options;
    bool is_path_known = false;  // some method is registered for the path: 405, else 404
    std::string allow;           // "DELETE, GET, HEAD, OPTIONS" when no handler was found or the method is OPTIONS
    std::vector<std::pair<std::string, std::string>> params;
  };
  // `method` as sent; HEAD finds GET.
  Match match(std::string_view method, const std::vector<std::string>& segments) const;

  // Methods of RFC 9110 and PATCH, except CONNECT; any other gets 501.
  static bool is_known_method(std::string_view method);

 private:
  struct Segment {
    enum class Kind { kText, kParameterText, kParameterParameter, kParameter, kRest } kind;
    std::string first;   // text or parameter name
    std::string second;  // text or parameter name behind the last dot
  };
  struct Route {
    std::string method, pattern;
    std::vector<Segment> segments;
    Handler handler;
    RouteOptions options;
  };
  static std::vector<Segment> parsed(std::string_view pattern);
  static bool fits(const Route& route, const std::vector<std::string>& segments, Match* match);

  std::vector<Route> routes_;  // most specific first
};

}  // namespace lodestone::http
