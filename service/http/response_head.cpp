#include "service/http/response_head.h"

#include <algorithm>
#include <charconv>

#include "service/http/status.h"

namespace lodestone::http {
namespace {

constexpr std::string_view kExposed =
    "Access-Control-Expose-Headers: ETag, Content-Length, Lodestone-Max-Error-M, Lodestone-Provenance, Retry-After, "
    "Server-Timing, X-Request-Id\r\n";

void append_number(std::string& out, std::size_t number) {
  char digits[24];
  const auto end = std::to_chars(digits, digits + sizeof digits, number).ptr;
  out.append(digits, end);
}

void append_field(std::string& out, std::string_view name, std::string_view value) {
  out.append(name).append(": ");
  const std::size_t start = out.size();
  out.append(value);
  // A control byte would end the field and begin another one.
  for (std::size_t i = start; i < out.size(); ++i)
    if (const auto byte = static_cast<unsigned char>(out[i]); (byte < 0x20 && byte != '\t') || byte == 0x7f) out[i] = '?';
  out.append("\r\n");
}

}  // namespace

bool is_bodiless(int status) { return status < 200 || status == 204 || status == 304; }

CorsPolicy::CorsPolicy(std::vector<std::string> origins)
    : origins_(std::move(origins)), is_any_(std::find(origins_.begin(), origins_.end(), "*") != origins_.end()) {}

bool CorsPolicy::allows(std::string_view origin) const {
  return is_any_ || std::find(origins_.begin(), origins_.end(), origin) != origins_.end();
}

void CorsPolicy::append_fields(const std::optional<std::string_view>& origin, std::string& head) const {
  if (origins_.empty()) return;
  if (is_any_) {
    head.append("Access-Control-Allow-Origin: *\r\n").append(kExposed);
    return;
  }
  head.append("Vary: Origin\r\n");
  if (!origin || !allows(*origin)) return;
  append_field(head, "Access-Control-Allow-Origin", *origin);
  head.append(kExposed);
}

Response CorsPolicy::options_response(const Request* request, std::string_view allow) const {
  Response response;
  response.status = 204;
  response.set("Allow", std::string(allow));
  const auto origin = request->header("Origin");
  if (!origin || !request->header("Access-Control-Request-Method") || !allows(*origin)) return response;
  response.set("Access-Control-Allow-Methods", std::string(allow));
  response.set("Access-Control-Allow-Headers", "Accept, Authorization, Content-Type, If-None-Match, traceparent");
  response.set("Access-Control-Max-Age", "86400");
  return response;
}

void HeadWriter::write(const Request* request, const Response& response, bool keep_alive, std::string& head) {
  head.assign("HTTP/1.1 ");
  append_number(head, static_cast<std::size_t>(response.status));
  head.append(" ").append(reason_phrase(response.status)).append("\r\nServer: Lodestone\r\n");
  if (const std::time_t now = std::time(nullptr); now != date_second_) {
    date_second_ = now;
    std::tm utc{};
    gmtime_r(&now, &utc);
    char text[64];
    const std::size_t size = std::strftime(text, sizeof text, "Date: %a, %d %b %Y %H:%M:%S GMT\r\n", &utc);
    date_line_.assign(text, size);
  }
  head.append(date_line_);
  if (!response.content_type.empty()) append_field(head, "Content-Type", response.content_type);
  if (!is_bodiless(response.status)) {
    head.append("Content-Length: ");
    append_number(head, response.body.size());
    head.append("\r\n");
  }
  for (const auto& [name, value] : response.headers) append_field(head, name, value);
  head.append("X-Content-Type-Options: nosniff\r\n");
  cors_.append_fields(request ? request->header("Origin") : std::nullopt, head);
  if (request && !request->request_id.empty()) append_field(head, "X-Request-Id", request->request_id);
  if (!keep_alive) {
    head.append("Connection: close\r\n");
  } else if (request && request->version < 11) {
    head.append("Connection: keep-alive\r\n");
  }
  head.append("\r\n");
}

}  // namespace lodestone::http
