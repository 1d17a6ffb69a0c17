#include "service/http/encoding.h"

#include <libdeflate.h>

#include <memory>

#include "service/http/etag.h"

namespace lodestone::http {
namespace {

constexpr std::size_t kMinCodedBytes = 512;

// Weight in thousandths of ";q=0.5", 1000 if there is none, 0 if it is broken (then we do not use that coding).
int weight_of(std::string_view parameters) {
  while (!parameters.empty()) {
    parameters.remove_prefix(1);  // the ';'
    const std::size_t end = parameters.find(';');
    const std::string_view one = trimmed(parameters.substr(0, end));
    parameters.remove_prefix(end == std::string_view::npos ? parameters.size() : end);
    if (one.size() < 2 || (one[0] != 'q' && one[0] != 'Q') || one[1] != '=') continue;
    const std::string_view number = one.substr(2);
    if (number.empty() || number.size() > 5 || (number[0] != '0' && number[0] != '1')) return 0;
    if (number.size() > 1 && number[1] != '.') return 0;
    int thousandths = (number[0] - '0') * 1000;
    int unit = 100;
    for (std::size_t i = 2; i < number.size(); ++i, unit /= 10) {
      if (number[i] < '0' || number[i] > '9') return 0;
      thousandths += (number[i] - '0') * unit;
    }
    return thousandths > 1000 ? 0 : thousandths;
  }
  return 1000;
}

}  // namespace

std::optional<Coding> negotiate_coding(const std::optional<std::string>& accept_encoding, bool has_gzip) {
  if (!accept_encoding) return Coding::kIdentity;
  int gzip = -1, identity = -1, any = -1;  // -1: not named
  std::string_view list = *accept_encoding;
  while (!list.empty()) {
    const std::size_t comma = list.find(',');
    const std::string_view member = list.substr(0, comma);
    list.remove_prefix(comma == std::string_view::npos ? list.size() : comma + 1);
    const std::size_t semicolon = member.find(';');
    const std::string_view name = trimmed(member.substr(0, semicolon));
    const int weight = weight_of(semicolon == std::string_view::npos ? std::string_view() : member.substr(semicolon));
    if (equals_ignoring_case(name, "gzip") || equals_ignoring_case(name, "x-gzip")) gzip = weight;
    if (equals_ignoring_case(name, "identity")) identity = weight;
    if (name == "*") any = weight;
  }
  if (gzip < 0) gzip = any < 0 ? 0 : any;
  const bool identity_excluded = identity == 0 || (identity < 0 && any == 0);
  // An identity that is not named is always acceptable, but never preferred to a named coding.
  const int identity_weight = identity_excluded ? -1 : (identity < 0 ? 0 : identity);
  if (has_gzip && gzip > 0 && gzip >= identity_weight) return Coding::kGzip;
  if (identity_excluded) return {};
  return Coding::kIdentity;
}

Result<std::string> gzip_compressed(std::string_view bytes, int level) {
  struct Closer {
    void operator()(libdeflate_compressor* c) const { libdeflate_free_compressor(c); }
  };
  const std::unique_ptr<libdeflate_compressor, Closer> compressor(libdeflate_alloc_compressor(level));
  if (!compressor) return Error{ErrorCode::kInternal, "gzip: no memory for a compressor of level " + std::to_string(level)};
  std::string out(libdeflate_gzip_compress_bound(compressor.get(), bytes.size()), '\0');
  const std::size_t size =
      libdeflate_gzip_compress(compressor.get(), bytes.data(), bytes.size(), out.data(), out.size());
  if (size == 0) return Error{ErrorCode::kInternal, "gzip: " + std::to_string(bytes.size()) + " bytes did not fit the bound"};
  out.resize(size);
  return out;
}

void encode_text(const Request& request, Response& response) {
  if (response.find("Content-Encoding")) return;
  response.set("Vary", "Accept-Encoding");
  if (response.body.size() < kMinCodedBytes) return;
  if (negotiate_coding(request.joined_header("Accept-Encoding"), true) != Coding::kGzip) return;
  auto coded = gzip_compressed(response.body.view());
  if (!coded || coded->size() >= response.body.size()) return;
  response.body = Body::from_string(std::move(*coded));
  response.set("Content-Encoding", "gzip");
  for (auto& [name, value] : response.headers)
    if (equals_ignoring_case(name, "ETag")) value = coded_etag(value, "gzip");
}

}  // namespace lodestone::http
