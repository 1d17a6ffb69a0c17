// Targets, fields, problems: what comes from the wire as values.

#include "service/http/message.h"

#include <gtest/gtest.h>

#include <nlohmann/json.hpp>

#include "service/http/problem.h"
#include "service/http/request_parser.h"
#include "service/http/status.h"

namespace lodestone::http {
namespace {

using Segments = std::vector<std::string>;
using Query = std::vector<std::pair<std::string, std::string>>;

TEST(Target, IsDecodedSegmentBySegment) {
  EXPECT_EQ(parse_target("/")->segments, Segments{});
  EXPECT_EQ(parse_target("/a/b.exr")->segments, (Segments{"a", "b.exr"}));
  EXPECT_EQ(parse_target("/a/")->segments, (Segments{"a", ""}));
  EXPECT_EQ(parse_target("/a%20b/%C3%A9+")->segments, (Segments{"a b", "\xC3\xA9+"}));
  EXPECT_EQ(parse_target("http://host:80/x?y=1")->segments, (Segments{"x"}));
  EXPECT_EQ(parse_target("http://host")->segments, Segments{});
  EXPECT_EQ(parse_target("/..a/.b")->segments, (Segments{"..a", ".b"}));
}

TEST(Target, KeepsTheOrderAndRepetitionOfQueryValues) {
  EXPECT_EQ(parse_target("/p?b=2&a=1&b=%26+x&flag&=v&&")->query,
            (Query{{"b", "2"}, {"a", "1"}, {"b", "& x"}, {"flag", ""}, {"", "v"}}));
}

class BadTarget : public testing::TestWithParam<const char*> {};
TEST_P(BadTarget, IsRefused) {
  const auto target = parse_target(GetParam());
  ASSERT_FALSE(target) << GetParam();
  EXPECT_EQ(target.error().code, ErrorCode::kInvalidArgument);
}
INSTANTIATE_TEST_SUITE_P(All, BadTarget,
                         testing::Values("", "a", "*", "//", "/a//b", "//a", "/../x", "/a/..", "/a/./b", "/%2e%2e/x", "/%2E./x", "/a%2fb",
                                         "/a%5Cb", "/a\\b", "/a%00", "/a%0d%0ab", "/%7f", "/%", "/%4", "/%zz", "/a%ff", "/%c0%af", "/%ed%a0%80", "/a?x=%",
                                         "/a?x=%00", "/a?%0a=1", "/a?x=%ff", "/a#b", "http://host?x", "/\x01"));

TEST(Traceparent, GivesItsTraceIdOnlyWhenWellFormed) {
  const std::string good = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01";
  EXPECT_EQ(trace_id_from_traceparent(good), "4bf92f3577b34da6a3ce929d0e0e4736");
  EXPECT_EQ(trace_id_from_traceparent("cc" + good.substr(2) + "-more"), "4bf92f3577b34da6a3ce929d0e0e4736");
  for (const std::string& bad : {std::string("nonsense"), good + "-more", "ff" + good.substr(2), good.substr(1), "00-00000000000000000000000000000000" + good.substr(35),
                                good.substr(0, 36) + "0000000000000000-01", "00-4BF92F3577B34DA6A3CE929D0E0E4736" + good.substr(35)})
    EXPECT_FALSE(trace_id_from_traceparent(bad)) << bad;
}

TEST(Echo, EscapesControlsAndBrokenUtf8AndIsCut) {
  EXPECT_EQ(safe_echo("plain \xC3\xA9"), "plain \xC3\xA9");
  EXPECT_EQ(safe_echo(std::string("a\r\n\x1b[0m\0", 9).substr(0, 8)), "a\\x0d\\x0a\\x1b[0m\\x00");
  EXPECT_EQ(safe_echo("\xff\xc2\x85"), "\\xff\\xc2\\x85");
  EXPECT_EQ(safe_echo(std::string(50, 'x'), 10), "xxxxxxxxxx...");
  EXPECT_EQ(safe_echo("aaa\xC3\xA9", 4), "aaa...");
}

TEST(Problem, IsValidJsonWithTheFieldsOfRfc9457) {
  const Response response = problem_response({ErrorCode::kOverloaded, "queue \"compute\": full\n\xff"}, "/a\"b", 7);
  EXPECT_EQ(response.status, 503);
  EXPECT_EQ(response.content_type, "application/problem+json");
  EXPECT_EQ(*response.find("retry-after"), "7");
  const auto json = nlohmann::json::parse(response.body.view());
  EXPECT_EQ(json["type"], "about:blank");
  EXPECT_EQ(json["title"], "Service Unavailable");
  EXPECT_EQ(json["status"], 503);
  EXPECT_EQ(json["detail"], "queue \"compute\": full\\x0a\\xff");
  EXPECT_EQ(json["instance"], "/a\"b");
  EXPECT_EQ(json["code"], "overloaded");
}

TEST(Problem, GivesEachErrorCodeItsStatus) {
  EXPECT_EQ(status_from_error(ErrorCode::kInvalidArgument), 400);
  EXPECT_EQ(status_from_error(ErrorCode::kNotFound), 404);
  EXPECT_EQ(status_from_error(ErrorCode::kGone), 410);
  EXPECT_EQ(status_from_error(ErrorCode::kTooLarge), 413);
  EXPECT_EQ(status_from_error(ErrorCode::kUnsupported), 422);
  EXPECT_EQ(status_from_error(ErrorCode::kConflict), 409);
  EXPECT_EQ(status_from_error(ErrorCode::kOverloaded), 503);
  EXPECT_EQ(status_from_error(ErrorCode::kDevice), 503);
  EXPECT_EQ(status_from_error(ErrorCode::kInternal), 500);
  EXPECT_EQ(problem_response({ErrorCode::kNotFound, "x"}, "").find("Retry-After"), nullptr);
}

constexpr HeadLimits kLimits{8192, 16384, 100};

TEST(Parser, FindsTheSameHeadHoweverItIsCut) {
  const std::string text = "\r\nPOST /a?b=c HTTP/1.1\r\nHost: x\r\nAccept: a\r\naccept:  b \r\nContent-Length: 5\r\n\r\nhelloGET";
  for (std::size_t first = 0; first <= text.size(); ++first) {
    RequestParser parser;
    std::size_t scanned = 0, used = 0;
    auto step = parser.read_head(std::string_view(text).substr(0, first), kLimits, &scanned, &used);
    if (step == RequestParser::Step::kNeedMore) step = parser.read_head(text, kLimits, &scanned, &used);
    ASSERT_EQ(step, RequestParser::Step::kDone) << first << " " << parser.refusal().detail;
    EXPECT_EQ(used, text.size() - 8);
    EXPECT_EQ(parser.request()->method, "POST");
    EXPECT_EQ(parser.request()->raw_target, "/a?b=c");
    EXPECT_EQ(parser.request()->header("ACCEPT"), "a");
    EXPECT_EQ(parser.request()->joined_header("accept"), "a, b");
    EXPECT_FALSE(parser.request()->header("missing"));
    std::size_t taken = 0;
    EXPECT_EQ(parser.read_body("hel", 5, &taken), RequestParser::Step::kNeedMore);
    EXPECT_EQ(taken, 3u);
    EXPECT_EQ(parser.read_body("loGET", 5, &taken), RequestParser::Step::kDone);
    EXPECT_EQ(taken, 2u);
    EXPECT_EQ(parser.request()->body, "hello");
  }
}

struct RefusedHead {
  const char* text;
  int status;
};
class BadHead : public testing::TestWithParam<RefusedHead> {};
TEST_P(BadHead, IsRefusedWithItsStatus) {
  RequestParser parser;
  std::size_t scanned = 0, used = 0;
  ASSERT_EQ(parser.read_head(GetParam().text, kLimits, &scanned, &used), RequestParser::Step::kRefused) << GetParam().text;
  EXPECT_EQ(parser.refusal().status, GetParam().status) << GetParam().text << parser.refusal().detail;
}
INSTANTIATE_TEST_SUITE_P(
    All, BadHead,
    testing::Values(RefusedHead{"GET / HTTP/1.1\r\n\r\n", 400}, RefusedHead{"GET / HTTP/1.1\r\nHost: a\r\nHost: a\r\n\r\n", 400},
                    RefusedHead{"GET / HTTP/1.1\r\nHost: a/b\r\n\r\n", 400}, RefusedHead{"GET / HTTP/2.0\r\nHost: a\r\n\r\n", 505},
                    RefusedHead{"GET / HTTP/1.1x\r\nHost: a\r\n\r\n", 400}, RefusedHead{"GET /\r\nHost: a\r\n\r\n", 400},
                    RefusedHead{"GET /a b HTTP/1.1\r\nHost: a\r\n\r\n", 400}, RefusedHead{"GET / HTTP/1.1\nHost: a\n\n", 400},
                    RefusedHead{"GET / HTTP/1.1\r\nHost : a\r\n\r\n", 400}, RefusedHead{"GET / HTTP/1.1\r\nHost: a\r\nX: b\x01\r\n\r\n", 400},
                    RefusedHead{"GET / HTTP/1.1\r\nHost: a\r\nX: b\r\n folded\r\n\r\n", 400},
                    RefusedHead{"GET / HTTP/1.1\r\nHost: a\r\nnonsense\r\n\r\n", 400},
                    RefusedHead{"POST / HTTP/1.1\r\nHost: a\r\nContent-Length: 3\r\nTransfer-Encoding: chunked\r\n\r\n", 400},
                    RefusedHead{"POST / HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: chunked\r\nContent-Length: 3\r\n\r\n", 400},
                    RefusedHead{"POST / HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: gzip, chunked\r\n\r\n", 501},
                    RefusedHead{"POST / HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: xchunked\r\n\r\n", 501},
                    RefusedHead{"POST / HTTP/1.0\r\nHost: a\r\nTransfer-Encoding: chunked\r\n\r\n", 400},
                    RefusedHead{"POST / HTTP/1.1\r\nHost: a\r\nContent-Length: 3\r\nContent-Length: 3\r\n\r\n", 400},
                    RefusedHead{"POST / HTTP/1.1\r\nHost: a\r\nContent-Length: -3\r\n\r\n", 400},
                    RefusedHead{"POST / HTTP/1.1\r\nHost: a\r\nContent-Length: 99999999999999999999\r\n\r\n", 400},
                    RefusedHead{"POST / HTTP/1.1\r\nHost: a\r\nExpect: tea\r\n\r\n", 417}, RefusedHead{"\x16\x03\x01\x02", 400},
                    RefusedHead{" GET / HTTP/1.1\r\n", 400}, RefusedHead{"G\x01T", 400}));

TEST(Parser, ReadsChunkedBodiesUpToTheLimit) {
  for (const std::size_t limit : {11u, 10u}) {
    RequestParser parser;
    std::size_t scanned = 0, used = 0, taken = 0;
    const std::string head = "POST / HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: chunked\r\n\r\n";
    ASSERT_EQ(parser.read_head(head, kLimits, &scanned, &used), RequestParser::Step::kDone);
    const auto step = parser.read_body("5\r\nhello\r\n6;ext=1\r\n world\r\n0\r\n\r\nGET", limit, &taken);
    if (limit == 11) {
      EXPECT_EQ(step, RequestParser::Step::kDone) << parser.refusal().detail;
      EXPECT_EQ(parser.request()->body, "hello world");
      EXPECT_EQ(taken, 32u);
    } else {
      EXPECT_EQ(step, RequestParser::Step::kRefused);
      EXPECT_EQ(parser.refusal().status, 413);
    }
  }
}

}  // namespace
}  // namespace lodestone::http
