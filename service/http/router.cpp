#include "service/http/router.h"

#include <algorithm>
#include <cassert>
#include <set>

namespace lodestone::http {

std::vector<Router::Segment> Router::parsed(std::string_view pattern) {
  using Kind = Segment::Kind;
  assert(!pattern.empty() && pattern[0] == '/' && "a pattern begins with '/'");
  std::vector<Segment> out;
  pattern.remove_prefix(1);
  bool is_done = pattern.empty();
  while (!is_done) {
    const std::size_t slash = pattern.find('/');
    const std::string_view raw = pattern.substr(0, slash);
    is_done = slash == std::string_view::npos;
    if (!is_done) pattern.remove_prefix(slash + 1);
    if (raw.empty() || raw[0] != '{') {
      out.push_back({Kind::kText, std::string(raw), ""});
      continue;
    }
    const std::size_t close = raw.find('}');
    assert(close != std::string_view::npos && "'{' without '}'");
    const std::string name(raw.substr(1, close - 1));
    const std::string_view behind = raw.substr(close + 1);
    if (name.size() > 3 && name.ends_with("...")) {
      assert(is_done && behind.empty() && "'{rest...}' must be last");
      out.push_back({Kind::kRest, name.substr(0, name.size() - 3), ""});
    } else if (behind.empty()) {
      out.push_back({Kind::kParameter, name, ""});
    } else {
      assert(behind[0] == '.' && behind.size() > 1 && "only '.' may follow a parameter");
      const std::string_view second = behind.substr(1);
      if (second[0] == '{') {
        out.push_back({Kind::kParameterParameter, name, std::string(second.substr(1, second.size() - 2))});
      } else {
        out.push_back({Kind::kParameterText, name, std::string(second)});
      }
    }
  }
  return out;
}

void Router::add(std::string_view method, std::string_view pattern, Handler handler, RouteOptions options) {
  assert(method != "HEAD" && method != "OPTIONS" && is_known_method(method));
  for ([[maybe_unused]] const Route& route : routes_)
    assert((route.method != method || route.pattern != pattern) && "the same route twice");
  Route route{std::string(method), std::string(pattern), parsed(pattern), std::move(handler), options};
  const auto is_more_specific = [](const Route& a, const Route& b) {
    return std::lexicographical_compare(a.segments.begin(), a.segments.end(), b.segments.begin(), b.segments.end(),
                                        [](const Segment& x, const Segment& y) { return x.kind < y.kind; });
  };
  routes_.insert(std::upper_bound(routes_.begin(), routes_.end(), route, is_more_specific), std::move(route));
}

std::vector<RouteInfo> Router::routes() const {
  std::vector<RouteInfo> out;
  for (const Route& route : routes_) out.push_back({route.method, route.pattern});
  std::sort(out.begin(), out.end(), [](const RouteInfo& a, const RouteInfo& b) {
    return std::tie(a.pattern, a.method) < std::tie(b.pattern, b.method);
  });
  return out;
}

bool Router::fits(const Route& route, const std::vector<std::string>& segments, Match* match) {
  using Kind = Segment::Kind;
  const bool has_rest = !route.segments.empty() && route.segments.back().kind == Kind::kRest;
  const std::size_t fixed = route.segments.size() - (has_rest ? 1 : 0);
  if (has_rest ? segments.size() < fixed : segments.size() != fixed) return false;
  for (std::size_t i = 0; i < fixed; ++i) {
    const Segment& want = route.segments[i];
    const std::string& have = segments[i];
    if (want.kind == Kind::kText) {
      if (have != want.first) return false;
      continue;
    }
    if (have.empty()) return false;
    if (want.kind == Kind::kParameter) {
      if (match) match->params.emplace_back(want.first, have);
      continue;
    }
    const std::size_t dot = have.rfind('.');
    if (dot == std::string::npos || dot == 0 || dot + 1 == have.size()) return false;
    if (want.kind == Kind::kParameterText && have.compare(dot + 1, std::string::npos, want.second) != 0) return false;
    if (!match) continue;
    match->params.emplace_back(want.first, have.substr(0, dot));
    if (want.kind == Kind::kParameterParameter) match->params.emplace_back(want.second, have.substr(dot + 1));
  }
  if (has_rest && match) {
    std::string rest;
    for (std::size_t i = fixed; i < segments.size(); ++i) rest += (i > fixed ? "/" : "") + segments[i];
    match->params.emplace_back(route.segments.back().first, std::move(rest));
  }
  return true;
}

Router::Match Router::match(std::string_view method, const std::vector<std::string>& segments) const {
  const std::string_view wanted = method == "HEAD" ? "GET" : method;
  Match out;
  for (const Route& route : routes_) {
    if (route.method != wanted || !fits(route, segments, nullptr)) continue;
    fits(route, segments, &out);
    out.handler = &route.handler;
    out.pattern = route.pattern;
    out.options = route.options;
    out.is_path_known = true;
    return out;
  }
  std::set<std::string_view> allowed;
  for (const Route& route : routes_) {
    if (!fits(route, segments, nullptr)) continue;
    allowed.insert(route.method);
    if (route.method == "GET") allowed.insert("HEAD");
  }
  out.is_path_known = !allowed.empty();
  if (out.is_path_known) allowed.insert("OPTIONS");
  for (const std::string_view one : allowed) out.allow += (out.allow.empty() ? "" : ", ") + std::string(one);
  return out;
}

bool Router::is_known_method(std::string_view method) {
  for (const std::string_view known : {"GET", "HEAD", "POST", "PUT", "DELETE", "OPTIONS", "PATCH", "TRACE"})
    if (method == known) return true;
  return false;
}

}  // namespace lodestone::http
