#pragma once
// Content codings: which one a client wants, and gzip.

#include <optional>
#include <string>
#include <string_view>

#include "kernels/types/result.h"
#include "service/http/message.h"

namespace lodestone::http {

enum class Coding { kIdentity, kGzip };

// RFC 9110 12.5.3 over "identity" and, if `has_gzip`, "gzip" (also x-gzip). No field: identity. Equal weights: gzip.
// Nothing when the client excludes all that we have ("identity;q=0" without gzip): the answer is 406.
std::optional<Coding> negotiate_coding(const std::optional<std::string>& accept_encoding, bool has_gzip);

// One gzip member without time or name: the same bytes for the same input. level 1..12 (libdeflate).
Result<std::string> gzip_compressed(std::string_view bytes, int level = 6);

// Codes a finished text answer (JSON, HTML, metrics; not tiles) as the request wants: adds Vary, and for gzip also
// Content-Encoding and the coded ETag. Bodies under 512 bytes and answers that have a Content-Encoding stay as they are.
void encode_text(const Request& request, Response& response);

}  // namespace lodestone::http
