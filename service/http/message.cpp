#include "service/http/message.h"

#include <algorithm>

#include "service/http/problem.h"

namespace lodestone::http {
namespace {

char lower(char c) { return c >= 'A' && c <= 'Z' ? static_cast<char>(c + 32) : c; }

int hex_value(char c) {
  if (c >= '0' && c <= '9') return c - '0';
  if (c >= 'a' && c <= 'f') return c - 'a' + 10;
  if (c >= 'A' && c <= 'F') return c - 'A' + 10;
  return -1;
}

bool is_control(char c) { return static_cast<unsigned char>(c) < 0x20 || c == 0x7f; }

Error broken(std::string_view what, std::string_view part, std::string_view rule) {
  return {ErrorCode::kInvalidArgument,
          std::string(what) + " '" + safe_echo(part, 80) + "': " + std::string(rule)};
}

// Percent-decodes one segment, key or value.
Result<std::string> decoded(std::string_view raw, std::string_view what, bool plus_is_space) {
  std::string out;
  out.reserve(raw.size());
  for (std::size_t i = 0; i < raw.size(); ++i) {
    char c = raw[i];
    if (c == '%') {
      const int high = i + 2 < raw.size() ? hex_value(raw[i + 1]) : -1;
      const int low = i + 2 < raw.size() ? hex_value(raw[i + 2]) : -1;
      if (high < 0 || low < 0) return broken(what, raw, "'%' must be followed by two hex digits");
      c = static_cast<char>(high * 16 + low);
      i += 2;
    } else if (c == '+' && plus_is_space) {
      c = ' ';
    }
    if (is_control(c)) return broken(what, raw, "control characters are not allowed");
    out.push_back(c);
  }
  if (!is_valid_utf8(out)) return broken(what, raw, "its decoded bytes must be UTF-8");
  return out;
}

Result<void> parse_path(std::string_view path, Target& target) {
  path.remove_prefix(1);
  if (path.empty()) return {};
  while (true) {
    const std::size_t slash = path.find('/');
    const bool is_last = slash == std::string_view::npos;
    const std::string_view raw = path.substr(0, slash);
    auto segment = decoded(raw, "path segment", false);
    if (!segment) return std::move(segment.error());
    if (segment->empty() && !is_last) return broken("path segment", raw, "empty segments ('//') are not allowed");
    if (*segment == "." || *segment == "..") return broken("path segment", raw, "'.' and '..' are not allowed");
    if (segment->find_first_of("/\\") != std::string::npos)
      return broken("path segment", raw, "'/' and '\\' inside a segment are not allowed");
    target.segments.push_back(std::move(*segment));
    if (is_last) return {};
    path.remove_prefix(slash + 1);
  }
}

Result<void> parse_query(std::string_view query, Target& target) {
  while (!query.empty()) {
    const std::size_t amp = query.find('&');
    const std::string_view pair = query.substr(0, amp);
    query.remove_prefix(amp == std::string_view::npos ? query.size() : amp + 1);
    if (pair.empty()) continue;
    const std::size_t equals = pair.find('=');
    auto key = decoded(pair.substr(0, equals), "query parameter", true);
    if (!key) return std::move(key.error());
    auto value = decoded(equals == std::string_view::npos ? std::string_view() : pair.substr(equals + 1), "query value", true);
    if (!value) return std::move(value.error());
    target.query.emplace_back(std::move(*key), std::move(*value));
  }
  return {};
}

}  // namespace

bool equals_ignoring_case(std::string_view a, std::string_view b) {
  return a.size() == b.size() &&
         std::equal(a.begin(), a.end(), b.begin(), [](char x, char y) { return lower(x) == lower(y); });
}

std::string_view trimmed(std::string_view text) {
  const std::size_t first = text.find_first_not_of(" \t");
  if (first == std::string_view::npos) return {};
  return text.substr(first, text.find_last_not_of(" \t") - first + 1);
}

bool is_valid_utf8(std::string_view text) {
  const auto* p = reinterpret_cast<const unsigned char*>(text.data());
  const auto* end = p + text.size();
  while (p < end) {
    if (*p < 0x80) {
      ++p;
      continue;
    }
    const int more = *p >= 0xf0 ? 3 : *p >= 0xe0 ? 2 : 1;
    if (*p < 0xc2 || *p > 0xf4 || end - p <= more) return false;
    // The second byte excludes overlong forms, surrogates and code points past U+10FFFF.
    const unsigned low = *p == 0xe0 ? 0xa0 : *p == 0xf0 ? 0x90 : 0x80;
    const unsigned high = *p == 0xed ? 0x9f : *p == 0xf4 ? 0x8f : 0xbf;
    if (p[1] < low || p[1] > high) return false;
    for (int i = 2; i <= more; ++i)
      if (p[i] < 0x80 || p[i] > 0xbf) return false;
    p += more + 1;
  }
  return true;
}

Result<Target> parse_target(std::string_view raw) {
  std::string_view rest = raw;
  for (const std::string_view scheme : {"http://", "https://"}) {
    if (rest.size() < scheme.size() || !equals_ignoring_case(rest.substr(0, scheme.size()), scheme)) continue;
    const std::size_t end = rest.find_first_of("/?", scheme.size());
    if (end == std::string_view::npos) return Target{};
    if (rest[end] == '?') return broken("request target", raw, "it needs a path that begins with '/'");
    rest.remove_prefix(end);
    break;
  }
  if (rest.empty() || rest[0] != '/') return broken("request target", raw, "it must begin with '/'");
  if (rest.find('#') != std::string_view::npos) return broken("request target", raw, "'#' is not allowed");
  const std::size_t mark = rest.find('?');
  Target target;
  if (auto ok = parse_path(rest.substr(0, mark), target); !ok) return std::move(ok.error());
  if (mark != std::string_view::npos)
    if (auto ok = parse_query(rest.substr(mark + 1), target); !ok) return std::move(ok.error());
  return target;
}

std::optional<std::string> trace_id_from_traceparent(std::string_view field) {
  field = trimmed(field);
  if (field.size() < 55 || (field.size() > 55 && (field[55] != '-' || field.substr(0, 2) == "00"))) return {};
  for (std::size_t i = 0; i < 55; ++i) {
    const bool is_dash = i == 2 || i == 35 || i == 52;
    if (is_dash ? field[i] != '-' : hex_value(field[i]) < 0 || field[i] != lower(field[i])) return {};
  }
  const std::string_view trace = field.substr(3, 32);
  const auto is_zero = [](std::string_view hex) { return hex.find_first_not_of('0') == std::string_view::npos; };
  if (field.substr(0, 2) == "ff" || is_zero(trace) || is_zero(field.substr(36, 16))) return {};
  return std::string(trace);
}

std::optional<std::string_view> Request::header(std::string_view name) const {
  for (const Field& field : fields)
    if (equals_ignoring_case(field.name, name)) return field.value;
  return {};
}

std::optional<std::string> Request::joined_header(std::string_view name) const {
  std::optional<std::string> out;
  for (const Field& field : fields) {
    if (!equals_ignoring_case(field.name, name)) continue;
    if (out) {
      *out += ", ";
    } else {
      out.emplace();
    }
    *out += field.value;
  }
  return out;
}

std::optional<std::string_view> Request::query(std::string_view key) const {
  for (const auto& [name, value] : target.query)
    if (name == key) return value;
  return {};
}

std::string_view Request::param(std::string_view name) const {
  for (const auto& [key, value] : params)
    if (key == name) return value;
  return {};
}

Body Body::from_string(std::string text) {
  auto owner = std::make_shared<const std::string>(std::move(text));
  const char* data = owner->data();
  const std::size_t size = owner->size();
  return Body(std::move(owner), data, size);
}

const std::string* Response::find(std::string_view name) const {
  for (const auto& [key, value] : headers)
    if (equals_ignoring_case(key, name)) return &value;
  return nullptr;
}

Response text_response(std::string content_type, std::string text, int status) {
  Response response;
  response.status = status;
  response.content_type = std::move(content_type);
  response.body = Body::from_string(std::move(text));
  return response;
}

}  // namespace lodestone::http
