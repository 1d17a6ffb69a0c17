#pragma once
// ServerCore: what the connections of one server share. Inside of service/http; users see server.h.

#include <atomic>
#include <boost/asio/io_context.hpp>
#include <boost/asio/ip/tcp.hpp>
#include <boost/asio/posix/stream_descriptor.hpp>
#include <boost/asio/post.hpp>
#include <boost/asio/steady_timer.hpp>
#include <chrono>
#include <memory>
#include <mutex>
#include <thread>
#include <unordered_set>
#include <vector>

#include "service/http/response_head.h"
#include "service/http/server.h"

namespace lodestone::http {

class Connection;

class ServerCore : public std::enable_shared_from_this<ServerCore> {
 public:
  using Clock = std::chrono::steady_clock;
  using Acceptor = boost::asio::ip::tcp::acceptor;

  ServerCore(Router router, ServerOptions options);
  ~ServerCore();

  // Any thread.
  Result<std::uint16_t> add_listener(int fd);  // before start()
  void start();
  void stop(std::chrono::milliseconds deadline);
  bool wait();
  ServerCounters counters() const;
  // Runs `task` on the io thread; drops it when that has ended.
  template <class Task>
  void post(Task&& task) {
    const std::lock_guard lock(post_mutex_);
    if (!is_ended_) boost::asio::post(io_, std::forward<Task>(task));
  }

  // The io thread alone.
  void remove(const std::shared_ptr<Connection>& connection);
  std::string new_request_id();
  void record(const AccessRecord& access);
  void count_timeout() { ++timeouts_; }
  bool is_io_thread() const { return std::this_thread::get_id() == io_thread_; }
  bool is_draining() const { return is_draining_; }
  std::uint64_t next_ticket() { return ++last_ticket_; }
  HeadWriter& head_writer() { return head_writer_; }

  const Router router;          // constant after construction
  const ServerOptions options;  // constant after construction
  const CorsPolicy cors;        // constant after construction

 private:
  void run();
  void arm_accept(std::size_t index);
  bool accept_some(std::size_t index);
  void accept_one(int fd, const std::string& remote_address);
  void arm_events();
  void take_events();
  void arm_sweep();
  void sweep();
  void begin_drain(std::chrono::milliseconds deadline);
  void drop_all();
  void end_if_drained();

  boost::asio::io_context io_{1};
  HeadWriter head_writer_;
  std::vector<std::unique_ptr<Acceptor>> acceptors_;
  std::vector<std::size_t> paused_;  // acceptors that wait for the next sweep, because there were no fds
  boost::asio::steady_timer sweep_timer_;
  // The clients' sockets have an epoll set of their own, edge-triggered and set up once a connection; Asio watches the set. Asio's
  // own waits would cost a system call for each request.
  boost::asio::posix::stream_descriptor events_;
  bool is_taking_events_ = false;
  std::vector<std::shared_ptr<Connection>> closed_meanwhile_;  // may still be named by the events in hand
  std::unordered_set<std::shared_ptr<Connection>> connections_;
  std::size_t max_connections_ = 0;
  Clock::duration sweep_interval_{};
  Clock::time_point drain_deadline_ = Clock::time_point::max();
  std::uint64_t last_ticket_ = 0;
  std::uint64_t id_high_ = 0, id_low_ = 0;  // of the last request id
  bool is_draining_ = false;
  bool was_dropped_ = false;
  std::thread::id io_thread_;  // set before the first handler runs

  std::thread thread_;
  std::atomic<bool> is_started_{false};
  std::atomic<int> stops_{0};
  std::mutex wait_mutex_;  // one joiner

  std::mutex post_mutex_;
  bool is_ended_ = false;  // guarded by post_mutex_

  std::atomic<std::uint64_t> open_{0}, accepted_{0}, refused_{0}, bytes_{0}, timeouts_{0}, aborted_{0};
  std::atomic<std::uint64_t> by_class_[6] = {};
};

}  // namespace lodestone::http
