#include "service/http/connection.h"

#include <sys/epoll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <utility>

#include "service/http/problem.h"

namespace lodestone::http {
namespace {

constexpr std::size_t kFirstBufferBytes = 4 * 1024;
constexpr std::size_t kBodyBufferBytes = 64 * 1024;
constexpr int kStepsPerTurn = 96;                  // three a request; then other connections have their turn
constexpr std::size_t kMaxLingerBytes = 64 << 20;  // more input than that after a refusal is not worth reading
constexpr int kBodyBytesPerMs = 4;               // the slowest upload that we wait for

constexpr auto kNever = ServerCore::Clock::time_point::max();

}  // namespace

Connection::Connection(std::shared_ptr<ServerCore> core, int fd, std::string remote_address)
    : core_(std::move(core)), fd_(fd), remote_address_(std::move(remote_address)) {}

Connection::~Connection() {
  if (fd_ >= 0) ::close(fd_);
}

void Connection::start() {
  request_start_ = Clock::now();
  deadline_ = request_start_ + core_->options.header_timeout;
  arm_read();
}

void Connection::start_refusal() {
  request_start_ = Clock::now();
  is_body_read_ = false;
  Response response = problem_response(
      {ErrorCode::kOverloaded, "too many connections: the limit is " + std::to_string(core_->options.max_connections)}, "", 5);
  core_->head_writer().write(nullptr, response, false, out_head_);
  out_head_.append(response.body.view());
  [[maybe_unused]] const auto sent = ::send(fd_, out_head_.data(), out_head_.size(), MSG_NOSIGNAL | MSG_DONTWAIT);
  begin_linger();
}

void Connection::process() {
  for (int turn = 0; turn < kStepsPerTurn; ++turn) {
    bool goes_on = false;
    switch (state_) {
      case State::kIdle:
      case State::kHead: goes_on = advance_head(); break;
      case State::kBody: goes_on = advance_body(); break;
      case State::kWriting: goes_on = advance_write(); break;
      default: return;
    }
    if (!goes_on) return;
  }
  post_process();
}

void Connection::post_process() {
  core_->post([self = shared_from_this()] { self->process(); });
}

// True: process() goes on; false: something is awaited, or all is over.
bool Connection::advance_head() {
  if (state_ == State::kIdle && in_begin_ != in_end_) {
    state_ = State::kHead;
    request_start_ = Clock::now();
    deadline_ = request_start_ + core_->options.header_timeout;
    head_scanned_ = 0;
    parser_.emplace();
  }
  if (state_ == State::kHead) {
    const ServerOptions& o = core_->options;
    std::size_t used = 0;
    const auto step = parser_->read_head(unread(), {o.max_request_line_bytes, o.max_header_bytes, o.max_header_fields},
                                         &head_scanned_, &used);
    if (step == RequestParser::Step::kRefused) {
      refuse(parser_->refusal());
      return true;
    }
    if (step == RequestParser::Step::kDone) {
      consume(used);
      return dispatch();
    }
  }
  if (is_peer_done_) {
    close();
    return false;
  }
  arm_read();
  return false;
}

// Routes by the head alone, so that a body that nobody wants is never read.
bool Connection::dispatch() {
  Request& request = *parser_->request();
  request.remote_address = remote_address_;
  const auto traceparent = request.header("traceparent");
  if (auto trace = traceparent ? trace_id_from_traceparent(*traceparent) : std::nullopt) {
    request.request_id = std::move(*trace);
  } else {
    request.request_id = core_->new_request_id();
  }
  const Framing& framing = parser_->framing();
  is_body_read_ = !framing.has_body();
  keeps_alive_ = framing.is_keep_alive;
  is_probed_ = false;
  const std::string_view path = request.raw_target.substr(0, request.raw_target.find('?'));

  if (!Router::is_known_method(request.method)) {
    answer_now(problem_response(501, "method '" + safe_echo(request.method, 40) + "': not known here", path));
    return true;
  }
  if (request.method == "OPTIONS" && request.raw_target == "*") {
    answer_now(core_->cors.options_response(&request, "GET, HEAD, POST, PUT, PATCH, DELETE, OPTIONS"));
    return true;
  }
  auto target = parse_target(request.raw_target);
  if (!target) {
    answer_now(problem_response(target.error(), path));
    return true;
  }
  request.target = std::move(*target);
  match_ = core_->router.match(request.method, request.target.segments);
  if (!match_.handler) {
    if (!match_.is_path_known) {
      answer_now(problem_response({ErrorCode::kNotFound, "path '" + safe_echo(path, 120) + "': nothing is served there"}, path));
    } else if (request.method == "OPTIONS") {
      answer_now(core_->cors.options_response(&request, match_.allow));
    } else {
      Response response = problem_response(
          405, "method " + std::string(request.method) + ": this path allows " + match_.allow, path, "method_not_allowed");
      answer_now(std::move(response.set("Allow", match_.allow)));
    }
    return true;
  }
  if (framing.content_length.value_or(0) > match_.options.max_body_bytes || (framing.is_chunked && match_.options.max_body_bytes == 0)) {
    answer_now(problem_response({ErrorCode::kTooLarge, "request body: at most " + std::to_string(match_.options.max_body_bytes) +
                                                           " bytes are taken here"}, path));
    return true;
  }
  if (const auto coding = request.header("Content-Encoding"); coding && framing.has_body() && !equals_ignoring_case(*coding, "identity")) {
    answer_now(problem_response(415, "Content-Encoding '" + safe_echo(*coding, 40) + "': send the body as it is", path));
    return true;
  }
  request.params = std::move(match_.params);
  begin_body();
  return true;
}

void Connection::begin_body() {
  state_ = State::kBody;
  body_start_ = Clock::now();
  deadline_ = body_start_ + core_->options.body_timeout;
  if (is_body_read_ || !parser_->framing().expects_continue || in_begin_ != in_end_) return;
  constexpr std::string_view kContinue = "HTTP/1.1 100 Continue\r\n\r\n";
  [[maybe_unused]] const auto sent = ::send(fd_, kContinue.data(), kContinue.size(), MSG_NOSIGNAL | MSG_DONTWAIT);
}

bool Connection::advance_body() {
  if (!is_body_read_) {
    std::size_t used = 0;
    const auto step = parser_->read_body(unread(), match_.options.max_body_bytes, &used);
    consume(used);
    if (step == RequestParser::Step::kRefused) {
      refuse(parser_->refusal());
      return true;
    }
    if (step == RequestParser::Step::kNeedMore) {
      if (is_peer_done_) {
        drop();
        return false;
      }
      const auto now = Clock::now();
      const std::size_t body_bytes = parser_->request()->body.size();
      deadline_ = std::min(now + core_->options.body_timeout, body_start_ + core_->options.body_timeout +
                                                                  std::chrono::milliseconds(body_bytes / kBodyBytesPerMs));
      arm_read();
      return false;
    }
    is_body_read_ = true;
  }
  state_ = State::kHandling;
  deadline_ = kNever;
  ticket_ = core_->next_ticket();
  pending_ = std::make_shared<ResponderState>(shared_from_this(), ticket_);
  is_in_handler_ = true;
  const std::string_view path = parser_->request()->raw_target;
  try {
    (*match_.handler)(parser_->request(), Responder(pending_));
  } catch (const std::exception& e) {  // a library's exception that slipped through: this request fails, not the server
    pending_->answer(problem_response({ErrorCode::kInternal, std::string("handler: ") + e.what()}, path.substr(0, path.find('?'))));
  }
  is_in_handler_ = false;
  if (inline_answer_) {
    Response response = std::move(*inline_answer_);
    inline_answer_.reset();
    begin_write(std::move(response));
    return true;
  }
  watch_client();
  return false;
}

void Connection::take_answer(std::uint64_t ticket, Response response) {
  if (core_->is_io_thread() && is_in_handler_ && ticket == ticket_) {  // advance_body() is waiting for it
    inline_answer_ = std::move(response);
    return;
  }
  core_->post([self = shared_from_this(), ticket, answer = std::move(response)]() mutable {
    if (self->state_ != State::kHandling || self->ticket_ != ticket) return;
    self->begin_write(std::move(answer));
    self->process();
  });
}

void Connection::refuse(const Refusal& refusal) {
  is_body_read_ = false;
  const std::shared_ptr<Request>& request = parser_->request();
  request->remote_address = remote_address_;
  if (request->request_id.empty()) request->request_id = core_->new_request_id();
  const std::string_view path = request->raw_target.substr(0, request->raw_target.find('?'));
  answer_now(problem_response(refusal.status, refusal.detail, path));
}

void Connection::answer_now(Response response) { begin_write(std::move(response)); }

void Connection::begin_write(Response response) {
  pending_.reset();
  response_ = std::move(response);
  state_ = State::kWriting;
  // A client that sent its last request and closed its side still gets answers to all that it sent.
  keeps_alive_ = keeps_alive_ && is_body_read_ && !core_->is_draining() && (!is_peer_done_ || in_begin_ != in_end_);
  const Request& request = *parser_->request();
  core_->head_writer().write(&request, response_, keeps_alive_, out_head_);
  sends_body_ = request.method != "HEAD" && !is_bodiless(response_.status);
  sent_bytes_ = 0;
  deadline_ = Clock::now() + core_->options.write_timeout;
}

bool Connection::advance_write() {
  const std::size_t body_bytes = sends_body_ ? response_.body.size() : 0;
  const std::size_t total = out_head_.size() + body_bytes;
  while (sent_bytes_ < total) {
    iovec parts[2];
    int count = 0;
    if (sent_bytes_ < out_head_.size()) parts[count++] = {out_head_.data() + sent_bytes_, out_head_.size() - sent_bytes_};
    const std::size_t body_sent = sent_bytes_ - std::min(sent_bytes_, out_head_.size());
    if (body_sent < body_bytes) parts[count++] = {const_cast<char*>(response_.body.data()) + body_sent, body_bytes - body_sent};
    msghdr message{};
    message.msg_iov = parts;
    message.msg_iovlen = static_cast<std::size_t>(count);
    const ssize_t sent = ::sendmsg(fd_, &message, MSG_NOSIGNAL | MSG_DONTWAIT);
    if (sent > 0) {
      sent_bytes_ += static_cast<std::size_t>(sent);
    } else if (errno == EAGAIN || errno == EWOULDBLOCK) {
      deadline_ = Clock::now() + core_->options.write_timeout;
      wants_write_ = true;
      return false;
    } else if (errno != EINTR) {
      drop();
      return false;
    }
  }
  finish_request();
  return state_ == State::kIdle;
}

void Connection::finish_request() {
  record(response_.status, false);
  response_ = Response();
  parser_.reset();
  if (!keeps_alive_) {
    begin_linger();
    return;
  }
  state_ = State::kIdle;
  deadline_ = Clock::now() + core_->options.idle_timeout;
}

// Closing while the client still sends would reset the connection and lose the answer on its way.
void Connection::begin_linger() {
  state_ = State::kLingering;
  deadline_ = Clock::now() + core_->options.linger_timeout;
  if (is_peer_done_) {
    close();
    return;
  }
  ::shutdown(fd_, SHUT_WR);
  in_begin_ = in_end_ = 0;
  arm_read();
}

void Connection::record(int status, bool is_aborted) {
  AccessRecord access;
  access.remote_address = remote_address_;
  if (parser_) {
    const Request& request = *parser_->request();
    access.request_id = request.request_id;
    access.method = request.method;
    access.target = request.raw_target;
    access.user_agent = request.header("User-Agent").value_or("");
    access.referer = request.header("Referer").value_or("");
  }
  access.status = status;
  if (state_ == State::kWriting) access.body_bytes = sent_bytes_ - std::min(sent_bytes_, out_head_.size());
  access.duration = Clock::now() - request_start_;
  access.is_aborted = is_aborted;
  core_->record(access);
}

void Connection::drop() {
  if (state_ == State::kWriting) {
    record(response_.status, true);
  } else if (state_ == State::kHandling || state_ == State::kBody || state_ == State::kHead) {
    record(499, true);
  }
  close();
}

void Connection::close() {
  if (state_ == State::kClosed) return;
  state_ = State::kClosed;
  const auto self = shared_from_this();
  wants_read_ = wants_write_ = false;
  ::close(std::exchange(fd_, -1));
  response_ = Response();
  if (const auto pending = std::exchange(pending_, nullptr)) pending->abandon();
  core_->remove(self);
}

void Connection::check_deadline(Clock::time_point now) {
  if (now < deadline_) return;
  switch (state_) {
    case State::kHandling:  // only half-closed clients have a deadline here
      deadline_ = kNever;
      if (!is_probed_ && parser_->request()->version >= 11) {
        is_probed_ = true;
        constexpr std::string_view kContinue = "HTTP/1.1 100 Continue\r\n\r\n";
        if (::send(fd_, kContinue.data(), kContinue.size(), MSG_NOSIGNAL | MSG_DONTWAIT) < 0 && errno != EAGAIN) drop();
      }
      return;
    case State::kHead:
    case State::kBody:
      core_->count_timeout();
      refuse({408, state_ == State::kHead ? "the request's head did not arrive in time" : "the request's body did not arrive in time"});
      process();
      return;
    case State::kWriting:
      core_->count_timeout();
      drop();
      return;
    default:
      close();
  }
}

void Connection::begin_drain(Clock::time_point now) {
  if (state_ == State::kIdle) deadline_ = std::min(deadline_, now + core_->options.drain_idle_time);
}

void Connection::on_event(std::uint32_t events) {
  if (state_ == State::kClosed) return;
  const auto self = shared_from_this();
  if (events & (EPOLLIN | EPOLLRDHUP | EPOLLHUP | EPOLLERR)) can_read_ = true;
  if (events & (EPOLLRDHUP | EPOLLHUP | EPOLLERR)) has_end_edge_ = true;
  if ((events & (EPOLLHUP | EPOLLERR)) && state_ == State::kHandling) drop_if_reset();
  if ((events & (EPOLLOUT | EPOLLHUP | EPOLLERR)) && wants_write_) {
    wants_write_ = false;
    process();
  }
  if (can_read_ && wants_read_) on_readable();
}

// Reading goes on in on_readable(), at the next edge or, if there is something left, in the next turn.
void Connection::arm_read() {
  wants_read_ = true;
  if (!can_read_) return;
  core_->post([self = shared_from_this()] {
    if (self->wants_read_ && self->can_read_) self->on_readable();
  });
}

void Connection::drop_if_reset() {
  int error = 0;
  socklen_t size = sizeof error;
  ::getsockopt(fd_, SOL_SOCKET, SO_ERROR, &error, &size);
  if (error != 0) drop();
}

Connection::Io Connection::receive() {
  if (in_.empty()) in_.resize(kFirstBufferBytes);
  if (in_begin_ > 0 && in_end_ == in_.size()) {
    std::memmove(in_.data(), in_.data() + in_begin_, in_end_ - in_begin_);
    in_end_ -= in_begin_;
    in_begin_ = 0;
  }
  const ServerOptions& o = core_->options;
  const std::size_t limit = std::max(kBodyBufferBytes, o.max_request_line_bytes + o.max_header_bytes + 1024);
  if (in_end_ == in_.size() && in_.size() < limit) in_.resize(std::min(limit, in_.size() * 4));
  if (in_end_ == in_.size()) return state_ == State::kHandling || state_ == State::kWriting ? Io::kBlocked : Io::kFailed;
  const std::size_t room = in_.size() - in_end_;
  const ssize_t got = ::recv(fd_, in_.data() + in_end_, room, MSG_DONTWAIT);
  can_read_ = got > 0 && (static_cast<std::size_t>(got) == room || has_end_edge_);
  if (got > 0) {
    in_end_ += static_cast<std::size_t>(got);
    return Io::kDone;
  }
  if (got == 0) {
    is_peer_done_ = true;
    return Io::kDone;
  }
  return errno == EAGAIN || errno == EWOULDBLOCK || errno == EINTR ? Io::kBlocked : Io::kFailed;
}

void Connection::on_readable() {
  wants_read_ = false;
  const Io io = receive();
  if (io == Io::kFailed) {
    drop();
    return;
  }
  switch (state_) {
    case State::kLingering:
      lingered_bytes_ += in_end_;
      in_begin_ = in_end_ = 0;
      if (is_peer_done_ || lingered_bytes_ > kMaxLingerBytes) {
        close();
      } else {
        arm_read();
      }
      return;
    case State::kHandling: watch_client(); return;
    case State::kWriting: return;  // read again when the answer is out
    default:
      if (io == Io::kBlocked) {
        arm_read();
      } else {
        process();
      }
  }
}

// While a worker computes: notices a client that goes away, and keeps what it sends ahead.
void Connection::watch_client() {
  if (is_peer_done_) {
    if (deadline_ == kNever && !is_probed_) deadline_ = Clock::now() + core_->options.half_close_probe_after;
  } else if (in_end_ - in_begin_ < kBodyBufferBytes) {
    arm_read();
  }
}

}  // namespace lodestone::http
