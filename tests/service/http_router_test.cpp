#include "service/http/router.h"

#include <gtest/gtest.h>

namespace lodestone::http {
namespace {

const Handler kNothing = [](std::shared_ptr<const Request>, Responder) {};

Router tile_router() {
  Router router;
  router.add("GET", "/", kNothing);
  router.add("GET", "/tiles/{layer}/{recipe}/{z}/{x}/{y}.{ext}", kNothing);
  router.add("GET", "/tiles/{layer}/{recipe}/layer.json", kNothing);
  router.add("GET", "/cesium/{z}/{y}.terrain", kNothing);
  router.add("GET", "/layers/{layer}", kNothing);
  router.add("GET", "/layers/all", kNothing);
  router.add("DELETE", "/layers/{layer}", kNothing, {.max_body_bytes = 7});
  router.add("GET", "/viewer/{path...}", kNothing);
  return router;
}

std::string params_of(const Router::Match& match) {
  std::string out(match.pattern);
  for (const auto& [name, value] : match.params) out += " " + name + "=" + value;
  return out;
}

std::string found(const Router& router, std::string_view method, std::string_view path) {
  const auto target = parse_target(path);
  const auto match = router.match(method, target->segments);
  return match.handler ? params_of(match) : match.is_path_known ? "405 " + match.allow : "404";
}

TEST(Router, FindsThePatternAndItsParameters) {
  const Router router = tile_router();
  EXPECT_EQ(found(router, "GET", "/"), "/");
  EXPECT_EQ(found(router, "GET", "/tiles/a/b/9/210/87.exr"), "/tiles/{layer}/{recipe}/{z}/{x}/{y}.{ext} layer=a recipe=b z=9 x=210 y=87 ext=exr");
  EXPECT_EQ(found(router, "GET", "/tiles/a/b/9/210/8.7.exr"), "/tiles/{layer}/{recipe}/{z}/{x}/{y}.{ext} layer=a recipe=b z=9 x=210 y=8.7 ext=exr");
  EXPECT_EQ(found(router, "GET", "/tiles/a/b/layer.json"), "/tiles/{layer}/{recipe}/layer.json layer=a recipe=b");
  EXPECT_EQ(found(router, "GET", "/cesium/3/4.terrain"), "/cesium/{z}/{y}.terrain z=3 y=4");
  EXPECT_EQ(found(router, "GET", "/viewer/"), "/viewer/{path...} path=");
  EXPECT_EQ(found(router, "GET", "/viewer/js/a.js"), "/viewer/{path...} path=js/a.js");
}

TEST(Router, TextBeatsParameters) {
  const Router router = tile_router();
  EXPECT_EQ(found(router, "GET", "/layers/all"), "/layers/all");
  EXPECT_EQ(found(router, "GET", "/layers/one"), "/layers/{layer} layer=one");
  EXPECT_EQ(found(router, "DELETE", "/layers/all"), "/layers/{layer} layer=all");
}

TEST(Router, HeadIsServedByGet) { EXPECT_EQ(found(tile_router(), "HEAD", "/layers/all"), "/layers/all"); }

TEST(Router, TellsUnknownPathsFromUnknownMethods) {
  const Router router = tile_router();
  for (const char* path : {"/x", "/tiles/a/b/9/210/87", "/tiles/a/b/9/210/.exr", "/tiles/a/b/9/210/87.", "/layers", "/layers/", "/layers/a/", "/cesium/3/4.exr"})
    EXPECT_EQ(found(router, "GET", path), "404") << path;
  EXPECT_EQ(found(router, "POST", "/layers/one"), "405 DELETE, GET, HEAD, OPTIONS");
  EXPECT_EQ(found(router, "PUT", "/tiles/a/b/9/210/87.exr"), "405 GET, HEAD, OPTIONS");
  EXPECT_TRUE(Router::is_known_method("TRACE"));
  EXPECT_FALSE(Router::is_known_method("BREW"));
  EXPECT_FALSE(Router::is_known_method("get"));
}

TEST(Router, GivesTheOptionsOfTheRouteAndListsAll) {
  const Router router = tile_router();
  EXPECT_EQ(router.match("DELETE", {"layers", "x"}).options.max_body_bytes, 7u);
  EXPECT_EQ(router.match("GET", {"layers", "x"}).options.max_body_bytes, 0u);
  const auto routes = router.routes();
  ASSERT_EQ(routes.size(), 8u);
  EXPECT_EQ(routes[0].pattern, "/");
  EXPECT_EQ(routes[3].method + routes[3].pattern, "DELETE/layers/{layer}");
}

TEST(Responder, AnswersOnceAndNeverForgets) {
  int answers = 0, status = 0;
  const auto take = [&](Response r) { ++answers, status = r.status; };
  {
    Responder responder = Responder::to(take);
    responder.send(text_response("text/plain", "a"));
    responder.send(text_response("text/plain", "b", 500));
  }
  EXPECT_EQ(answers, 1);
  EXPECT_EQ(status, 200);
  { Responder forgotten = Responder::to(take); }
  EXPECT_EQ(answers, 2);
  EXPECT_EQ(status, 500);
}

}  // namespace
}  // namespace lodestone::http
