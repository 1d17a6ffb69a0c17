#include "service/http/request_parser.h"

#include <boost/asio/buffer.hpp>
#include <algorithm>
#include <limits>

#include "service/http/problem.h"

namespace lodestone::http {
namespace {

namespace beast = boost::beast;

bool is_token_byte(char c) {
  if ((c >= 'A' && c <= 'Z') || (c >= 'a' && c <= 'z') || (c >= '0' && c <= '9')) return true;
  return c != '\0' && std::string_view("!#$%&'*+-.^_`|~").find(c) != std::string_view::npos;
}

// Letters, digits and what IP literals, ports and registered names need.
bool is_host(std::string_view host) {
  return std::all_of(host.begin(), host.end(), [](char c) {
    return is_token_byte(c) || std::string_view("[]:();,=").find(c) != std::string_view::npos;
  }) && host.find(',') == std::string_view::npos;
}

// "HTTP/2.0": a version that is well formed but not ours.
bool ends_with_version(std::string_view line) {
  if (line.size() < 9 || std::count(line.begin(), line.end(), ' ') != 2) return false;
  const std::string_view v = line.substr(line.size() - 9);
  return v.substr(0, 6) == " HTTP/" && v[6] >= '0' && v[6] <= '9' && v[7] == '.' && v[8] >= '0' && v[8] <= '9';
}

}  // namespace

RequestParser::Step RequestParser::refuse(int status, std::string detail) {
  refusal_ = {status, std::move(detail)};
  return Step::kRefused;
}

RequestParser::Step RequestParser::read_head(std::string_view bytes, const HeadLimits& limits, std::size_t* scanned,
                                             std::size_t* used) {
  std::size_t begin = 0;  // empty lines before a request line are skipped (RFC 9112 2.2)
  while (begin < 4 && bytes.substr(begin, 2) == "\r\n") begin += 2;
  const std::string_view head = bytes.substr(begin);

  // The first bytes tell a TLS handshake or a binary protocol from HTTP without waiting for the rest.
  const std::string_view method = head.substr(0, std::min<std::size_t>(head.find(' '), 32));
  if (begin < bytes.size() && head != "\r" && (method.empty() || !std::all_of(method.begin(), method.end(), [](char c) {
        return is_token_byte(c) || c == '\r' || c == '\n';
      })))
    return refuse(400, "request line: it must begin with a method");

  const std::size_t line_end = head.find('\n');
  const std::size_t line_bytes = std::min(line_end, head.size());
  if (line_bytes > limits.max_request_line_bytes + 1)
    return refuse(414, "request line: at most " + std::to_string(limits.max_request_line_bytes) + " bytes are read");
  if (line_end == std::string_view::npos) return Step::kNeedMore;
  if (line_end == 0 || head[line_end - 1] != '\r') return refuse(400, "request line: it must end with CR LF");

  const std::size_t from = std::max(*scanned > 3 ? *scanned - 3 : 0, line_end - 1);
  const std::size_t end = head.find("\r\n\r\n", from);
  *scanned = head.size();
  const std::size_t head_bytes = end == std::string_view::npos ? head.size() : end + 4;
  if (head_bytes - line_bytes > limits.max_header_bytes + 4)
    return refuse(431, "header fields: at most " + std::to_string(limits.max_header_bytes) + " bytes are read");
  if (end == std::string_view::npos) return Step::kNeedMore;

  *used = begin + head_bytes;
  request_->head = head.substr(0, head_bytes);
  request_->fields.reserve(12);
  max_fields_ = limits.max_header_fields;
  Base::header_limit(std::numeric_limits<std::uint32_t>::max());
  Base::body_limit(std::numeric_limits<std::uint64_t>::max());
  ErrorCode ec;
  Base::put(boost::asio::buffer(request_->head), ec);
  if (refusal_.status != 400 || !refusal_.detail.empty()) return Step::kRefused;
  if (ec == beast::http::error::bad_version && ends_with_version(head.substr(0, line_end - 1)))
    return refuse(505, "request line: HTTP/1.1 and HTTP/1.0 are spoken here");
  if (ec || !Base::is_header_done()) return refuse(400, "malformed request: " + (ec ? ec.message() : "incomplete head"));
  return check_head();
}

// The rules that are ours rather than the grammar's.
RequestParser::Step RequestParser::check_head() {
  int hosts = 0, lengths = 0;
  std::optional<std::string> transfer, expect;
  for (const Request::Field& field : request_->fields) {
    if (equals_ignoring_case(field.name, "Host")) {
      ++hosts;
      if (!is_host(field.value)) return refuse(400, "Host '" + safe_echo(field.value, 80) + "': not a host name");
    } else if (equals_ignoring_case(field.name, "Content-Length")) {
      ++lengths;
    } else if (equals_ignoring_case(field.name, "Transfer-Encoding")) {
      transfer = request_->joined_header("Transfer-Encoding");
    } else if (equals_ignoring_case(field.name, "Expect")) {
      expect = field.value;
    }
  }
  if (hosts > 1) return refuse(400, "Host: one field is allowed, " + std::to_string(hosts) + " found");
  if (hosts == 0 && request_->version >= 11) return refuse(400, "Host: the field is missing");
  if (lengths > 1) return refuse(400, "Content-Length: one field is allowed, " + std::to_string(lengths) + " found");
  if (transfer) {
    if (lengths > 0) return refuse(400, "Transfer-Encoding: not together with Content-Length");
    if (request_->version < 11) return refuse(400, "Transfer-Encoding: not in HTTP/1.0");
    if (!equals_ignoring_case(*transfer, "chunked"))
      return refuse(501, "Transfer-Encoding '" + safe_echo(*transfer, 80) + "': only chunked is understood");
    framing_.is_chunked = true;
  }
  if (expect && request_->version >= 11) {
    if (!equals_ignoring_case(*expect, "100-continue"))
      return refuse(417, "Expect '" + safe_echo(*expect, 80) + "': only 100-continue is understood");
    framing_.expects_continue = true;
  }
  if (const auto length = Base::content_length(); lengths > 0 && length) framing_.content_length = *length;
  framing_.is_keep_alive = Base::keep_alive();
  return Step::kDone;
}

RequestParser::Step RequestParser::read_body(std::string_view bytes, std::size_t max_bytes, std::size_t* used) {
  max_body_bytes_ = max_bytes;
  *used = 0;
  while (!Base::is_done()) {
    ErrorCode ec;
    const std::size_t taken = Base::put(boost::asio::buffer(bytes.data() + *used, bytes.size() - *used), ec);
    *used += taken;
    if (refusal_.status != 400) return Step::kRefused;
    if (ec == beast::http::error::need_more) return Step::kNeedMore;
    if (ec) return refuse(400, "malformed request body: " + ec.message());
    if (*used == bytes.size() && !Base::is_done()) return Step::kNeedMore;
  }
  return Step::kDone;
}

void RequestParser::on_request_impl(beast::http::verb, View method, View target, int version, ErrorCode&) {
  request_->method = {method.data(), method.size()};
  request_->raw_target = {target.data(), target.size()};
  request_->version = version;
}

void RequestParser::on_field_impl(beast::http::field, View name, View value, ErrorCode& ec) {
  const std::string& head = request_->head;
  const bool is_folded = !value.empty() && (value.data() < head.data() || value.data() >= head.data() + head.size());
  const bool has_control = std::any_of(value.begin(), value.end(), [](char c) {
    return (static_cast<unsigned char>(c) < 0x20 && c != '\t') || c == 0x7f;
  });
  if (is_folded || has_control) {
    refuse(400, "header field '" + safe_echo({name.data(), name.size()}, 80) + "': folded lines and control characters are not allowed");
  } else if (request_->fields.size() >= max_fields_) {
    refuse(431, "header fields: at most " + std::to_string(max_fields_) + " are read");
  } else {
    request_->fields.push_back({{name.data(), name.size()}, {value.data(), value.size()}});
    return;
  }
  ec = beast::http::error::bad_value;
}

std::size_t RequestParser::on_body_impl(View body, ErrorCode& ec) {
  if (body.size() > max_body_bytes_ - std::min(max_body_bytes_, request_->body.size())) {
    refuse(413, "request body: at most " + std::to_string(max_body_bytes_) + " bytes are taken here");
    ec = beast::http::error::body_limit;
    return 0;
  }
  request_->body.append(body.data(), body.size());
  return body.size();
}

std::size_t RequestParser::on_chunk_body_impl(std::uint64_t, View body, ErrorCode& ec) { return on_body_impl(body, ec); }

}  // namespace lodestone::http
