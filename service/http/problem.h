#pragma once
// Error answers: RFC 9457 problem+json.

#include <string>
#include <string_view>

#include "kernels/types/result.h"
#include "service/http/message.h"

namespace lodestone::http {

// Text of unknown origin made fit for a message: bytes that are not UTF-8 and control characters become \xNN, and what is longer
// than max_bytes is cut at a character with "..." behind it. '<', '>' and '&' stay: JSON and logs do not read them.
std::string safe_echo(std::string_view text, std::size_t max_bytes = 200);

// A JSON string literal, quotes included. Bytes that are not UTF-8 become U+FFFD.
std::string json_string(std::string_view text);

// {"type","title","status","detail","instance","code"}; type is about:blank, title the status' phrase, code a stable word
// (omitted if empty), instance the request's path (omitted if empty). `detail` and `instance` pass through safe_echo.
Response problem_response(int status, std::string_view detail, std::string_view instance, std::string_view code = {});

// The same for an Error, by the table in status.cpp. kOverloaded gets Retry-After.
Response problem_response(const Error& error, std::string_view instance, int retry_after_s = 1);

}  // namespace lodestone::http
