#pragma once
// Connection: one client. Reads a request, routes it, waits for the answer, writes it, repeats. Inside of service/http.

#include <sys/uio.h>

#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "service/http/request_parser.h"
#include "service/http/responder.h"
#include "service/http/server_core.h"

namespace lodestone::http {

// Lives on the io thread, except take_answer(). Kept alive by the core's set and by its pending waits.
class Connection : public AnswerSink, public std::enable_shared_from_this<Connection> {
 public:
  using Clock = ServerCore::Clock;
  // Takes the socket `fd`, which must be non-blocking.
  Connection(std::shared_ptr<ServerCore> core, int fd, std::string remote_address);
  ~Connection() override;

  int fd() const { return fd_; }
  // Edges of the socket, as epoll tells them.
  void on_event(std::uint32_t events);

  void start();
  // Answers 503 and closes: there are too many connections.
  void start_refusal();
  // Called a few times a second: acts if the deadline of the present state has passed.
  void check_deadline(Clock::time_point now);
  // Graceful stop: gives an idle client a last moment.
  void begin_drain(Clock::time_point now);
  // Drops the client now.
  void drop();
  bool has_work() const { return state_ != State::kIdle && state_ != State::kLingering && state_ != State::kClosed; }

  void take_answer(std::uint64_t ticket, Response response) override;

 private:
  enum class State { kIdle, kHead, kBody, kHandling, kWriting, kLingering, kClosed };
  enum class Io { kDone, kBlocked, kFailed };

  void process();
  void post_process();
  bool advance_head();
  bool advance_body();
  void begin_body();
  bool dispatch();
  void refuse(const Refusal& refusal);
  void answer_now(Response response);
  void begin_write(Response response);
  bool advance_write();
  void finish_request();
  void begin_linger();
  void close();
  void record(int status, bool is_aborted);

  void arm_read();
  void drop_if_reset();
  void on_readable();
  Io receive();
  void watch_client();

  std::string_view unread() const { return {in_.data() + in_begin_, in_end_ - in_begin_}; }
  void consume(std::size_t bytes) {
    in_begin_ += bytes;
    if (in_begin_ == in_end_) in_begin_ = in_end_ = 0;
  }

  const std::shared_ptr<ServerCore> core_;
  int fd_;  // -1 once closed
  const std::string remote_address_;
  State state_ = State::kIdle;
  Clock::time_point deadline_;

  // Input.
  std::vector<char> in_;
  std::size_t in_begin_ = 0, in_end_ = 0;
  bool can_read_ = false;     // an edge has come and not all is read
  bool wants_read_ = false, wants_write_ = false;
  bool has_end_edge_ = false;  // the end of input is among the edges, so a short read has not drained it
  bool is_peer_done_ = false;  // the client has closed its sending side
  std::size_t lingered_bytes_ = 0;

  // The present request.
  std::optional<RequestParser> parser_;
  std::size_t head_scanned_ = 0;
  Router::Match match_;
  Clock::time_point request_start_, body_start_;
  bool is_body_read_ = true;  // false: the rest of the input cannot be a request
  bool is_probed_ = false;
  std::uint64_t ticket_ = 0;
  std::shared_ptr<ResponderState> pending_;
  bool is_in_handler_ = false;
  std::optional<Response> inline_answer_;

  // Output.
  Response response_;
  std::string out_head_;
  std::size_t sent_bytes_ = 0;
  bool sends_body_ = false;
  bool keeps_alive_ = true;
};

}  // namespace lodestone::http
