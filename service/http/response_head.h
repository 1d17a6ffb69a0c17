#pragma once
// Writes the status line and header fields of an answer.

#include <ctime>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "service/http/message.h"

namespace lodestone::http {

class CorsPolicy {
 public:
  explicit CorsPolicy(std::vector<std::string> origins);
  // Appends Access-Control-Allow-Origin (and Vary: Origin unless "*") for a request from `origin`.
  void append_fields(const std::optional<std::string_view>& origin, std::string& head) const;
  // The answer to OPTIONS: 204 with Allow, and the preflight fields if the origin is allowed.
  Response options_response(const Request* request, std::string_view allow) const;

 private:
  bool allows(std::string_view origin) const;
  const std::vector<std::string> origins_;
  bool is_any_ = false;
};

class HeadWriter {
 public:
  explicit HeadWriter(const CorsPolicy& cors) : cors_(cors) {}
  // Replaces `head`. request may be null (the head could not be parsed).
  void write(const Request* request, const Response& response, bool keep_alive, std::string& head);

 private:
  const CorsPolicy& cors_;
  std::time_t date_second_ = -1;
  std::string date_line_;  // "Date: ...\r\n" of that second
};

// True for statuses whose answers have no body by definition: 1xx, 204, 304.
bool is_bodiless(int status);

}  // namespace lodestone::http
