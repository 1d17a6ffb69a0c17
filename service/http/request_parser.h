#pragma once
// Reads one request from a byte stream; Boost.Beast does the grammar, the limits and the strict rules are here.

#include <boost/beast/http/basic_parser.hpp>
#include <cstddef>
#include <memory>
#include <optional>
#include <string>
#include <string_view>

#include "service/http/message.h"

namespace lodestone::http {

struct HeadLimits {
  std::size_t max_request_line_bytes, max_header_bytes, max_header_fields;
};

// Why a request is refused; the connection closes after it.
struct Refusal {
  int status = 400;
  std::string detail;
};

// What the framing fields of a head say.
struct Framing {
  std::optional<std::uint64_t> content_length;
  bool is_chunked = false;
  bool is_keep_alive = true;
  bool expects_continue = false;
  bool has_body() const { return is_chunked || content_length.value_or(0) > 0; }
};

class RequestParser : private boost::beast::http::basic_parser<true> {
 public:
  enum class Step { kNeedMore, kDone, kRefused };

  // Looks for a whole head in `bytes` (all received so far). kDone: `used` bytes are the head, and request() has method, target, fields;
  // the target is not decoded yet. kRefused: see refusal(); request() has what could be read. `*scanned` keeps the place
  // between calls; 0 at first.
  Step read_head(std::string_view bytes, const HeadLimits& limits, std::size_t* scanned, std::size_t* used);

  // Feeds body bytes. kDone: the message is whole, `used` bytes were taken. More than max_bytes: kRefused with 413.
  Step read_body(std::string_view bytes, std::size_t max_bytes, std::size_t* used);

  const std::shared_ptr<Request>& request() const { return request_; }
  const Framing& framing() const { return framing_; }
  const Refusal& refusal() const { return refusal_; }

 private:
  using Base = boost::beast::http::basic_parser<true>;
  using ErrorCode = boost::beast::error_code;
  using View = boost::beast::string_view;

  void on_request_impl(boost::beast::http::verb, View method, View target, int version, ErrorCode&) override;
  void on_response_impl(int, View, int, ErrorCode&) override {}
  void on_field_impl(boost::beast::http::field, View name, View value, ErrorCode&) override;
  void on_header_impl(ErrorCode&) override {}
  void on_body_init_impl(const boost::optional<std::uint64_t>&, ErrorCode&) override {}
  std::size_t on_body_impl(View body, ErrorCode&) override;
  void on_chunk_header_impl(std::uint64_t, View, ErrorCode&) override {}
  std::size_t on_chunk_body_impl(std::uint64_t, View body, ErrorCode&) override;
  void on_finish_impl(ErrorCode&) override {}

  Step refuse(int status, std::string detail);
  Step check_head();

  std::shared_ptr<Request> request_ = std::make_shared<Request>();
  Framing framing_;
  Refusal refusal_;
  std::size_t max_fields_ = 0;
  std::size_t max_body_bytes_ = 0;
};

}  // namespace lodestone::http
