#pragma once
// Result<T>: a value, or an Error that says what the world did. Bugs are asserts, not Errors.

#include <cassert>
#include <string>
#include <utility>
#include <variant>

namespace lodestone {

// What kind of thing went wrong. service/http/status.cpp turns it into an HTTP status, service/cli into an exit code.
enum class ErrorCode {
  kInvalidArgument,  // the caller's input breaks a rule
  kNotFound,         // the named thing does not exist
  kGone,             // it existed under an older revision
  kTooLarge,         // over a stated limit
  kUnsupported,      // well formed, but not something that we read or write
  kConflict,         // somebody else holds the lock, or the state forbids it
  kOverloaded,       // a bounded queue is full; try again later
  kCancelled,        // nobody waits for the answer any more
  kCorrupt,          // stored bytes fail their checksum or format
  kDevice,           // OpenCL said no
  kIo,               // file system, memory map or socket
  kInternal,
};

// One error: `message` names the object, the rule, what was found and, where there is one, the next step.
struct Error {
  ErrorCode code = ErrorCode::kInternal;
  std::string message;

  // Adds the task during which it happened: "while <task>: <message>".
  Error within(const std::string& task) && {
    return Error{code, "while " + task + ": " + std::move(message)};
  }
};

template <class T>
class [[nodiscard]] Result {
 public:
  Result(T value) : state_(std::in_place_index<0>, std::move(value)) {}      // NOLINT: implicit on purpose
  Result(Error error) : state_(std::in_place_index<1>, std::move(error)) {}  // NOLINT: implicit on purpose

  explicit operator bool() const { return state_.index() == 0; }
  T& operator*() & { return value(); }
  const T& operator*() const& { return value(); }
  T&& operator*() && { return std::move(value()); }
  T* operator->() { return &value(); }
  const T* operator->() const { return &value(); }
  T& value() {
    assert(*this && "value() of a failed Result");
    return std::get<0>(state_);
  }
  const T& value() const {
    assert(*this && "value() of a failed Result");
    return std::get<0>(state_);
  }
  Error& error() {
    assert(!*this && "error() of a good Result");
    return std::get<1>(state_);
  }
  const Error& error() const {
    assert(!*this && "error() of a good Result");
    return std::get<1>(state_);
  }

 private:
  std::variant<T, Error> state_;
};

// Success without a value.
template <>
class [[nodiscard]] Result<void> {
 public:
  Result() = default;
  Result(Error error) : error_(std::move(error)), is_ok_(false) {}  // NOLINT: implicit on purpose

  explicit operator bool() const { return is_ok_; }
  Error& error() {
    assert(!is_ok_ && "error() of a good Result");
    return error_;
  }
  const Error& error() const {
    assert(!is_ok_ && "error() of a good Result");
    return error_;
  }

 private:
  Error error_;
  bool is_ok_ = true;
};

}  // namespace lodestone
