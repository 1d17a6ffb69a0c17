#include "service/http/encoding.h"

#include <gtest/gtest.h>
#include <libdeflate.h>

namespace lodestone::http {
namespace {

using C = std::optional<Coding>;

TEST(AcceptEncoding, IsNegotiatedByWeight) {
  const auto with_gzip = [](const char* field) { return negotiate_coding(std::string(field), true); };
  EXPECT_EQ(negotiate_coding(std::nullopt, true), C(Coding::kIdentity));
  for (const char* field : {"gzip", "GZip", "x-gzip", "br, gzip;q=0.5", "*", "gzip;q=1.0, identity;q=0.5", "identity;q=0, gzip;q=0.001", "gzip ; q=0.2", "*;q=0.1", "gzip, identity", "identity;q=0, *"})
    EXPECT_EQ(with_gzip(field), C(Coding::kGzip)) << field;
  for (const char* field : {"", "identity", "br", "zstd, br", "gzip;q=0", "gzip;q=0, *", "gzip;q=0.000", "gzip;q=0.5, identity", "gzip;q=2", "gzip;q=x", "gzip;q=", "gzipp"})
    EXPECT_EQ(with_gzip(field), C(Coding::kIdentity)) << field;
  for (const char* field : {"identity;q=0", "*;q=0", "gzip;q=0, identity;q=0", "br, *;q=0"}) EXPECT_EQ(with_gzip(field), C()) << field;
}

TEST(AcceptEncoding, WithoutGzipOnlyIdentityRemains) {
  EXPECT_EQ(negotiate_coding("gzip", false), C(Coding::kIdentity));
  EXPECT_EQ(negotiate_coding("gzip, identity;q=0", false), C());
}

std::string unzipped(std::string_view bytes, std::size_t size) {
  std::string out(size, '\0');
  libdeflate_decompressor* d = libdeflate_alloc_decompressor();
  EXPECT_EQ(libdeflate_gzip_decompress(d, bytes.data(), bytes.size(), out.data(), out.size(), nullptr), LIBDEFLATE_SUCCESS);
  libdeflate_free_decompressor(d);
  return out;
}

TEST(Gzip, GivesTheSameBytesBackAndIsDeterministic) {
  std::string text;
  for (int i = 0; i < 3000; ++i) text += std::to_string(i * i);
  const auto a = gzip_compressed(text), b = gzip_compressed(text);
  ASSERT_TRUE(a && b);
  EXPECT_EQ(*a, *b);
  EXPECT_LT(a->size(), text.size());
  EXPECT_EQ(unzipped(*a, text.size()), text);
  EXPECT_EQ(unzipped(*gzip_compressed(""), 0), "");
}

TEST(EncodeText, CodesLargeTextsForThoseWhoAccept) {
  Request request;
  request.fields = {{"Accept-Encoding", "gzip"}};
  const std::string text(2000, 'a');
  Response response = text_response("application/json", text);
  response.set("ETag", "\"v1\"");
  encode_text(request, response);
  EXPECT_EQ(*response.find("Content-Encoding"), "gzip");
  EXPECT_EQ(*response.find("ETag"), "\"v1-gzip\"");
  EXPECT_EQ(*response.find("Vary"), "Accept-Encoding");
  EXPECT_EQ(unzipped(response.body.view(), text.size()), text);

  Response again = response;  // coded once only
  encode_text(request, again);
  EXPECT_EQ(again.body.view(), response.body.view());
}

TEST(EncodeText, LeavesOthersAlone) {
  Request request;
  Response plain = text_response("application/json", std::string(2000, 'a'));
  encode_text(request, plain);
  EXPECT_EQ(plain.find("Content-Encoding"), nullptr);
  EXPECT_EQ(*plain.find("Vary"), "Accept-Encoding");
  request.fields = {{"Accept-Encoding", "gzip"}};
  Response small = text_response("application/json", "{}");
  encode_text(request, small);
  EXPECT_EQ(small.body.view(), "{}");
}

}  // namespace
}  // namespace lodestone::http
