#pragma once
// Request and Response: the plain values between the HTTP server and its handlers.

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "kernels/types/result.h"

namespace lodestone::http {

// ASCII letters compare equal in either case; other bytes as they are.
bool equals_ignoring_case(std::string_view a, std::string_view b);
// Without leading and trailing spaces and tabs.
std::string_view trimmed(std::string_view text);
bool is_valid_utf8(std::string_view text);

// What a request target asks for, decoded.
struct Target {
  std::vector<std::string> segments;  // "/a/b" -> {"a","b"}, "/" -> {}, "/a/" -> {"a",""}
  std::vector<std::pair<std::string, std::string>> query;  // in the order of the URL; "k" alone -> {"k",""}; '+' is a space
};

// Decodes "/path?query" (or "http://host/path?query"). kInvalidArgument for: no leading '/', a broken or non-UTF-8
// escape, control characters, an encoded '/' or '\\', a '\\', '#', an empty segment before the last, "." or ".." segments.
Result<Target> parse_target(std::string_view raw);

// The trace id of a W3C traceparent field ("00-<32 hex>-<16 hex>-<2 hex>"), nothing if it is malformed or all zero.
std::optional<std::string> trace_id_from_traceparent(std::string_view field);

// One request. Constant once a handler sees it; may be read by any thread.
class Request {
 public:
  struct Field {
    std::string_view name, value;  // into the request's own copy of its head
  };

  std::string_view method;      // as sent: "GET", "HEAD", ...
  std::string_view raw_target;  // as sent, undecoded
  Target target;
  std::vector<Field> fields;
  std::string body;
  std::string remote_address;  // "192.0.2.7" or "2001:db8::7", of the socket's other end
  std::string request_id;      // 32 hex digits: the traceparent's trace id, else a fresh one
  int version = 11;            // 10 or 11
  std::vector<std::pair<std::string, std::string>> params;  // filled by the router: {"z","9"}

  // The first field of that name, case ignored; nothing if absent.
  std::optional<std::string_view> header(std::string_view name) const;
  // All fields of that name joined with ", " (RFC 9110 5.2); nothing if absent.
  std::optional<std::string> joined_header(std::string_view name) const;
  // The first query value of that key; nothing if absent.
  std::optional<std::string_view> query(std::string_view key) const;
  // A path parameter of the matched pattern; empty if the pattern has none of that name.
  std::string_view param(std::string_view name) const;

  std::string head;  // request line and fields, what the views point into; never changed afterwards
};

// Bytes with an owner: a cached tile is sent from where it lies.
class Body {
 public:
  Body() = default;
  // Shares `owner`, which keeps data[0, size) alive and unchanged.
  Body(std::shared_ptr<const void> owner, const void* data, std::size_t size)
      : owner_(std::move(owner)), data_(static_cast<const char*>(data)), size_(size) {}
  static Body from_string(std::string text);
  // Any container with data() and size() of bytes.
  template <class Bytes>
  static Body shared(std::shared_ptr<const Bytes> bytes) {
    const void* data = bytes->data();
    const std::size_t size = bytes->size() * sizeof(*bytes->data());
    return Body(std::move(bytes), data, size);
  }
  // Bytes that live as long as the program (embedded files).
  static Body from_static(std::string_view text) { return Body(nullptr, text.data(), text.size()); }

  const char* data() const { return data_; }
  std::size_t size() const { return size_; }
  bool empty() const { return size_ == 0; }
  std::string_view view() const { return {data_, size_}; }

 private:
  std::shared_ptr<const void> owner_;
  const char* data_ = nullptr;
  std::size_t size_ = 0;
};

// One answer. The server adds Content-Length, Date, Server, Connection, CORS and the security fields.
struct Response {
  int status = 200;
  std::string content_type;  // empty: no Content-Type
  std::vector<std::pair<std::string, std::string>> headers;  // control bytes in a value are sent as '?'
  Body body;                 // not sent for HEAD, 204 and 304

  Response& set(std::string name, std::string value) {
    headers.emplace_back(std::move(name), std::move(value));
    return *this;
  }
  // The first header of that name, case ignored; nullptr if absent.
  const std::string* find(std::string_view name) const;
};

// 200 with a text of that type.
Response text_response(std::string content_type, std::string text, int status = 200);

}  // namespace lodestone::http
