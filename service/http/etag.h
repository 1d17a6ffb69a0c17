#pragma once
// Entity tags (RFC 9110 8.8.3) and If-None-Match (13.1.2).

#include <string>
#include <string_view>

namespace lodestone::http {

// "\"opaque\"". `opaque` must hold no quote, space or control byte.
std::string strong_etag(std::string_view opaque);

// The tag of the same content in a content coding: "\"abc\"" + "gzip" -> "\"abc-gzip\"".
std::string coded_etag(std::string_view etag, std::string_view coding);

// True if both are strong and equal; for If-Match and If-Range.
bool strong_equal(std::string_view a, std::string_view b);

// True if the field's list names `etag` (with or without W/), or is "*". Unquoted and broken members match nothing.
bool none_match_names(std::string_view field, std::string_view etag);

}  // namespace lodestone::http
