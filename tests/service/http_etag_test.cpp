#include "service/http/etag.h"

#include <gtest/gtest.h>

namespace lodestone::http {
namespace {

TEST(Etag, IsQuotedAndNamesItsCoding) {
  EXPECT_EQ(strong_etag("abc"), "\"abc\"");
  EXPECT_EQ(coded_etag("\"abc\"", "gzip"), "\"abc-gzip\"");
}

TEST(Etag, StrongComparisonRefusesWeakTags) {
  EXPECT_TRUE(strong_equal("\"a\"", "\"a\""));
  EXPECT_FALSE(strong_equal("W/\"a\"", "W/\"a\""));
  EXPECT_FALSE(strong_equal("\"a\"", "W/\"a\""));
  EXPECT_FALSE(strong_equal("\"a\"", "\"b\""));
  EXPECT_FALSE(strong_equal("a", "a"));
}

TEST(IfNoneMatch, NamesATagInAnyForm) {
  for (const char* field : {"\"a\"", "W/\"a\"", "*", " * ", "\"x\", \"a\"", "\"x\",W/\"a\",\"y\"", "\"x,\\\" , \"a\"", ", \"a\" ,", "a, \"a\"", "\"a\"  , \"b\""})
    EXPECT_TRUE(none_match_names(field, "\"a\"")) << field;
}

TEST(IfNoneMatch, DoesNotNameOthers) {
  for (const char* field : {"", "a", "\"b\"", "\"a", "a\"", "\"A\"", "\"b, \"a", "w/\"a\"", "\"x\", *", "\"a\"b", "W/", "W/a", "'a'", "\"ab\"", "\"a-gzip\""})
    EXPECT_FALSE(none_match_names(field, "\"a\"")) << field;
}

}  // namespace
}  // namespace lodestone::http
