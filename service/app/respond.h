#pragma once
// Small helpers that every route shares.

#include <nlohmann/json.hpp>
#include <set>
#include <string>

#include "kernels/types/result.h"
#include "service/http/encoding.h"
#include "service/http/message.h"
#include "service/http/problem.h"
#include "service/http/responder.h"

namespace lodestone {

inline void send_error(const http::Request& request, http::Responder& responder, const Error& error, int retry_after_s = 1) {
  responder.send(http::problem_response(error, request.raw_target, retry_after_s));
}

inline void send_text(const http::Request& request, http::Responder& responder, http::Response response) {
  http::encode_text(request, response);
  responder.send(std::move(response));
}

inline void send_json(const http::Request& request, http::Responder& responder, const nlohmann::ordered_json& json, int status = 200,
                      const std::string& content_type = "application/json") {
  http::Response response = http::text_response(content_type, json.dump(1, ' ', false, nlohmann::ordered_json::error_handler_t::replace), status);
  response.set("Cache-Control", "no-cache");
  send_text(request, responder, std::move(response));
}

// Error kInvalidArgument for a query key that is not in `allowed`, or that comes twice.
inline Result<void> check_query(const http::Request& request, const std::set<std::string>& allowed) {
  std::set<std::string> seen;
  for (const auto& [name, value] : request.target.query) {
    if (allowed.count(name) == 0) {
      std::string list;
      for (const std::string& known : allowed) list += (list.empty() ? "" : ", ") + known;
      return Error{ErrorCode::kInvalidArgument, "unknown query key " + name + "; there " + (list.empty() ? "are none here" : "are: " + list)};
    }
    if (!seen.insert(name).second) return Error{ErrorCode::kInvalidArgument, "query key " + name + " was given twice"};
  }
  return {};
}

// "http://host:port" as the client sees us: the Host header, https behind a proxy that says so.
inline std::string base_url(const http::Request& request) {
  const auto host = request.header("Host");
  const auto scheme = request.header("X-Forwarded-Proto");
  return std::string(scheme && *scheme == "https" ? "https://" : "http://") + std::string(host ? *host : "localhost");
}

}  // namespace lodestone
