#include "service/http/responder.h"

#include <utility>

#include "service/http/problem.h"

namespace lodestone::http {
namespace {

class FunctionSink : public AnswerSink {
 public:
  explicit FunctionSink(std::function<void(Response)> take) : take_(std::move(take)) {}
  void take_answer(std::uint64_t, Response response) override { take_(std::move(response)); }

 private:
  const std::function<void(Response)> take_;
};

}  // namespace

void ResponderState::answer(Response response) {
  std::shared_ptr<AnswerSink> sink;
  std::function<void()> unused;  // destroyed outside the lock
  {
    const std::lock_guard lock(mutex_);
    sink = std::move(sink_);
    sink_.reset();
    unused.swap(on_abandoned_);
  }
  if (sink) sink->take_answer(ticket_, std::move(response));
}

void ResponderState::abandon() {
  std::shared_ptr<AnswerSink> sink;
  std::function<void()> callback;
  {
    const std::lock_guard lock(mutex_);
    if (!sink_) return;
    is_abandoned_ = true;
    sink = std::move(sink_);
    sink_.reset();
    callback.swap(on_abandoned_);
  }
  if (callback) callback();
}

void ResponderState::set_on_abandoned(std::function<void()> callback) {
  {
    const std::lock_guard lock(mutex_);
    if (sink_) {
      on_abandoned_ = std::move(callback);
      return;
    }
    if (!is_abandoned_) return;
  }
  callback();
}

Responder Responder::to(std::function<void(Response)> take) {
  return Responder(std::make_shared<ResponderState>(std::make_shared<FunctionSink>(std::move(take)), 0));
}

Responder& Responder::operator=(Responder&& other) noexcept {
  std::swap(state_, other.state_);
  return *this;
}

Responder::~Responder() {
  if (state_) send(problem_response(500, "the request's handler ended without an answer", ""));
}

void Responder::send(Response response) {
  const std::shared_ptr<ResponderState> state = std::move(state_);
  state_.reset();
  if (state) state->answer(std::move(response));
}

void Responder::on_abandoned(std::function<void()> callback) {
  if (state_) state_->set_on_abandoned(std::move(callback));
}

}  // namespace lodestone::http
