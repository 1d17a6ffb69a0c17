#pragma once
// Responder: the promise of one answer to one request.

#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>

#include "service/http/message.h"

namespace lodestone::http {

// Where answers go; called at most once per ticket, from any thread.
class AnswerSink {
 public:
  virtual ~AnswerSink() = default;
  virtual void take_answer(std::uint64_t ticket, Response response) = 0;
};

// What a Responder and its connection share.
class ResponderState {
 public:
  ResponderState(std::shared_ptr<AnswerSink> sink, std::uint64_t ticket) : ticket_(ticket), sink_(std::move(sink)) {}
  void answer(Response response);
  void abandon();
  void set_on_abandoned(std::function<void()> callback);

 private:
  const std::uint64_t ticket_ = 0;
  std::mutex mutex_;  // guards all below
  std::shared_ptr<AnswerSink> sink_;  // empty once answered or abandoned
  std::function<void()> on_abandoned_;
  bool is_abandoned_ = false;
};

// Move-only; all members may be called from any thread, one thread at a time. Destroying it unsent answers 500.
class Responder {
 public:
  explicit Responder(std::shared_ptr<ResponderState> state) : state_(std::move(state)) {}
  // For tests of handlers and for wrapping: the answer goes to `take` on the thread that sends it.
  static Responder to(std::function<void(Response)> take);
  Responder(Responder&&) noexcept = default;
  Responder& operator=(Responder&& other) noexcept;
  ~Responder();

  // Gives the answer; the first call counts, later ones do nothing.
  void send(Response response);
  // `callback` runs once, on the server's thread, if the client goes away before the answer; at once, on the calling thread, if it
  // already has. It must be quick. Never runs after send().
  void on_abandoned(std::function<void()> callback);

 private:
  std::shared_ptr<ResponderState> state_;  // empty once sent or moved from
};

}  // namespace lodestone::http
