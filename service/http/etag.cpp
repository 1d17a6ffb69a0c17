#include "service/http/etag.h"

#include "service/http/message.h"

namespace lodestone::http {
namespace {

// Without a W/ prefix.
std::string_view without_weak(std::string_view etag) {
  if (etag.substr(0, 2) == "W/") etag.remove_prefix(2);
  return etag;
}

bool is_quoted(std::string_view text) {
  return text.size() >= 2 && text.front() == '"' && text.back() == '"';
}

}  // namespace

std::string strong_etag(std::string_view opaque) { return '"' + std::string(opaque) + '"'; }

std::string coded_etag(std::string_view etag, std::string_view coding) {
  std::string out(etag);
  out.insert(out.size() - 1, "-" + std::string(coding));
  return out;
}

bool strong_equal(std::string_view a, std::string_view b) { return is_quoted(a) && a == b; }

bool none_match_names(std::string_view field, std::string_view etag) {
  field = trimmed(field);
  if (field == "*") return true;
  const std::string_view wanted = without_weak(etag);
  while (!field.empty()) {
    // A comma may stand inside the quotes, so members are read by their quotes.
    field = trimmed(field);
    if (!field.empty() && field[0] == ',') {
      field.remove_prefix(1);
      continue;
    }
    const std::string_view rest = without_weak(field);
    if (rest.empty()) return false;
    if (rest[0] != '"') {  // an unquoted member: skip it
      const std::size_t comma = field.find(',');
      if (comma == std::string_view::npos) return false;
      field.remove_prefix(comma + 1);
      continue;
    }
    const std::size_t close = rest.find('"', 1);
    if (close == std::string_view::npos) return false;
    const std::string_view after = trimmed(rest.substr(close + 1));
    if ((after.empty() || after[0] == ',') && rest.substr(0, close + 1) == wanted) return true;
    const std::size_t comma = rest.find(',', close);
    if (comma == std::string_view::npos) return false;
    field = rest.substr(comma + 1);
  }
  return false;
}

}  // namespace lodestone::http
