#include "service/http/problem.h"

#include "service/http/status.h"

namespace lodestone::http {
namespace {

constexpr char kHex[] = "0123456789abcdef";
constexpr std::size_t kMaxDetailBytes = 1000;

// Length of the UTF-8 character at the start of text, 0 if there is none.
std::size_t character_bytes(std::string_view text) {
  const auto first = static_cast<unsigned char>(text[0]);
  const std::size_t bytes = first < 0x80 ? 1 : first < 0xe0 ? 2 : first < 0xf0 ? 3 : 4;
  return text.size() >= bytes && is_valid_utf8(text.substr(0, bytes)) ? bytes : 0;
}

// C0, DEL and, in UTF-8, C1.
bool is_control_character(std::string_view character) {
  const auto first = static_cast<unsigned char>(character[0]);
  return first < 0x20 || first == 0x7f ||
         (character.size() == 2 && first == 0xc2 && static_cast<unsigned char>(character[1]) < 0xa0);
}

}  // namespace

std::string safe_echo(std::string_view text, std::size_t max_bytes) {
  std::string out;
  while (!text.empty()) {
    std::size_t bytes = character_bytes(text);
    std::string piece;
    if (bytes == 0 || is_control_character(text.substr(0, bytes))) {
      bytes = bytes == 0 ? 1 : bytes;
      for (const char c : text.substr(0, bytes)) {
        const auto byte = static_cast<unsigned char>(c);
        piece += {'\\', 'x', kHex[byte >> 4], kHex[byte & 15]};
      }
    } else {
      piece = text.substr(0, bytes);
    }
    if (out.size() + piece.size() > max_bytes) return out + "...";
    out += piece;
    text.remove_prefix(bytes);
  }
  return out;
}

std::string json_string(std::string_view text) {
  std::string out = "\"";
  while (!text.empty()) {
    const std::size_t bytes = character_bytes(text);
    const char c = text[0];
    if (bytes == 0) {
      out += "\\ufffd";
    } else if (c == '"' || c == '\\') {
      out += {'\\', c};
    } else if (static_cast<unsigned char>(c) < 0x20 || c == 0x7f) {
      out += {'\\', 'u', '0', '0', kHex[static_cast<unsigned char>(c) >> 4], kHex[c & 15]};
    } else {
      out += text.substr(0, bytes);
    }
    text.remove_prefix(bytes == 0 ? 1 : bytes);
  }
  out += '"';
  return out;
}

Response problem_response(int status, std::string_view detail, std::string_view instance, std::string_view code) {
  std::string json = "{\"type\":\"about:blank\",\"title\":" + json_string(reason_phrase(status)) +
                     ",\"status\":" + std::to_string(status) + ",\"detail\":" + json_string(safe_echo(detail, kMaxDetailBytes));
  if (!instance.empty()) json += ",\"instance\":" + json_string(safe_echo(instance));
  if (!code.empty()) json += ",\"code\":" + json_string(code);
  json += "}\n";
  Response response = text_response("application/problem+json", std::move(json), status);
  response.set("Cache-Control", "no-store");
  return response;
}

Response problem_response(const Error& error, std::string_view instance, int retry_after_s) {
  Response response =
      problem_response(status_from_error(error.code), error.message, instance, word_from_error(error.code));
  if (error.code == ErrorCode::kOverloaded) response.set("Retry-After", std::to_string(retry_after_s));
  return response;
}

}  // namespace lodestone::http
