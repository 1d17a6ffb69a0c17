#include "service/http/server.h"

#include <fcntl.h>
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <arpa/inet.h>
#include <sys/epoll.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <cassert>
#include <cerrno>
#include <cstring>
#include <random>
#include <utility>

#include "service/http/connection.h"
#include "service/http/server_core.h"

namespace lodestone::http {
namespace {

constexpr int kAcceptsPerTurn = 64;
constexpr int kEventsPerTurn = 256;
constexpr int kMaxUnsentBytes = 128 * 1024;
constexpr std::size_t kSpareFds = 256;  // for files, devices and the admin listener
constexpr std::chrono::milliseconds kMaxSweep{250}, kMinSweep{10};

// Raises the soft limit to the hard one; gives what holds afterwards.
std::size_t raised_fd_limit() {
  rlimit limit{};
  if (::getrlimit(RLIMIT_NOFILE, &limit) != 0) return 1024;
  if (limit.rlim_cur < limit.rlim_max) {
    limit.rlim_cur = limit.rlim_max;
    if (::setrlimit(RLIMIT_NOFILE, &limit) != 0) ::getrlimit(RLIMIT_NOFILE, &limit);
  }
  return limit.rlim_cur == RLIM_INFINITY ? 1 << 20 : static_cast<std::size_t>(limit.rlim_cur);
}

std::string text_from_address(const sockaddr_storage& address) {
  char text[INET6_ADDRSTRLEN] = "";
  if (address.ss_family == AF_INET) {
    ::inet_ntop(AF_INET, &reinterpret_cast<const sockaddr_in&>(address).sin_addr, text, sizeof text);
  } else if (address.ss_family == AF_INET6) {
    const auto& v6 = reinterpret_cast<const sockaddr_in6&>(address).sin6_addr;
    if (IN6_IS_ADDR_V4MAPPED(&v6)) {
      ::inet_ntop(AF_INET, &v6.s6_addr[12], text, sizeof text);
    } else {
      ::inet_ntop(AF_INET6, &v6, text, sizeof text);
    }
  }
  return text;
}

Result<std::uint16_t> port_of(int fd) {
  sockaddr_storage address{};
  socklen_t size = sizeof address;
  if (::getsockname(fd, reinterpret_cast<sockaddr*>(&address), &size) != 0)
    return Error{ErrorCode::kIo, std::string("listening socket: ") + std::strerror(errno)};
  if (address.ss_family == AF_INET) return ntohs(reinterpret_cast<const sockaddr_in&>(address).sin_port);
  if (address.ss_family == AF_INET6) return ntohs(reinterpret_cast<const sockaddr_in6&>(address).sin6_port);
  return Error{ErrorCode::kInvalidArgument, "listening socket: a TCP socket is needed"};
}

// "host:port", "[v6]:port", ":port".
Result<std::pair<std::string, std::string>> split_address(const std::string& address) {
  const std::size_t colon = address.rfind(':');
  const Error error{ErrorCode::kInvalidArgument, "listen address '" + address + "': HOST:PORT is needed, such as 127.0.0.1:8080 or [::1]:8080"};
  if (colon == std::string::npos) return error;
  std::string host = address.substr(0, colon);
  const std::string port = address.substr(colon + 1);
  if (port.empty() || port.size() > 5 || port.find_first_not_of("0123456789") != std::string::npos || std::stoi(port) > 65535) return error;
  if (!host.empty() && host.front() == '[') {
    if (host.size() < 3 || host.back() != ']') return error;
    host = host.substr(1, host.size() - 2);
  } else if (host.find(':') != std::string::npos) {
    return error;
  }
  return std::pair{host, port};
}

std::uint64_t random_word() {
  std::random_device device;
  return (static_cast<std::uint64_t>(device()) << 32) | device();
}

}  // namespace

ServerCore::ServerCore(Router router_in, ServerOptions options_in)
    : router(std::move(router_in)), options(std::move(options_in)), cors(options.cors_origins), head_writer_(cors), sweep_timer_(io_), events_(io_, ::epoll_create1(EPOLL_CLOEXEC)),
      id_high_(random_word()), id_low_(random_word()) {
  const std::size_t fds = raised_fd_limit();
  max_connections_ = std::min(options.max_connections, fds > 2 * kSpareFds ? fds - kSpareFds : fds / 2);
  const auto shortest = std::min({options.header_timeout, options.idle_timeout, options.body_timeout, options.write_timeout,
                                  options.linger_timeout, options.drain_idle_time, options.half_close_probe_after});
  sweep_interval_ = std::clamp(std::chrono::milliseconds(shortest / 4), kMinSweep, kMaxSweep);
}

ServerCore::~ServerCore() = default;

Result<std::uint16_t> ServerCore::add_listener(int fd) {
  auto port = port_of(fd);
  if (!port) return port;
  sockaddr_storage address{};
  socklen_t size = sizeof address;
  ::getsockname(fd, reinterpret_cast<sockaddr*>(&address), &size);
  auto acceptor = std::make_unique<Acceptor>(io_);
  boost::system::error_code ec;
  acceptor->assign(address.ss_family == AF_INET ? boost::asio::ip::tcp::v4() : boost::asio::ip::tcp::v6(), fd, ec);
  if (!ec) acceptor->non_blocking(true, ec);
  if (ec) return Error{ErrorCode::kIo, "listening socket: " + ec.message()};
  acceptors_.push_back(std::move(acceptor));
  return port;
}

void ServerCore::start() {
  assert(!is_started_ && "start() once");
  is_started_ = true;
  thread_ = std::thread([self = shared_from_this()] { self->run(); });
}

void ServerCore::run() {
  io_thread_ = std::this_thread::get_id();
  for (std::size_t i = 0; i < acceptors_.size(); ++i) arm_accept(i);
  arm_sweep();
  arm_events();
  io_.run();  // ends when the drain has closed everything
  {
    const std::lock_guard lock(post_mutex_);
    is_ended_ = true;
  }
  io_.restart();
  io_.poll();  // what was posted in between
}

void ServerCore::arm_accept(std::size_t index) {
  acceptors_[index]->async_wait(Acceptor::wait_read, [self = shared_from_this(), index](const boost::system::error_code& ec) {
    if (ec || self->is_draining_) return;
    if (self->accept_some(index)) {
      self->arm_accept(index);
    } else {
      self->paused_.push_back(index);
    }
  });
}

// False: no fds are left. The kernel would report the waiting client again at once, so the acceptor pauses.
bool ServerCore::accept_some(std::size_t index) {
  for (int i = 0; i < kAcceptsPerTurn; ++i) {
    sockaddr_storage address{};
    socklen_t size = sizeof address;
    const int fd = ::accept4(acceptors_[index]->native_handle(), reinterpret_cast<sockaddr*>(&address), &size, SOCK_NONBLOCK | SOCK_CLOEXEC);
    if (fd >= 0) {
      accept_one(fd, text_from_address(address));
      continue;
    }
    if (errno == EINTR || errno == ECONNABORTED) continue;
    if (errno == EMFILE || errno == ENFILE || errno == ENOBUFS || errno == ENOMEM) {
      ++refused_;
      return false;
    }
    return true;
  }
  return true;
}

void ServerCore::accept_one(int fd, const std::string& remote_address) {
  const int on = 1;
  ::setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
  // A client that does not read must not make the kernel hold megabytes for it.
  ::setsockopt(fd, IPPROTO_TCP, TCP_NOTSENT_LOWAT, &kMaxUnsentBytes, sizeof kMaxUnsentBytes);
  const bool is_refused = connections_.size() >= max_connections_;
  if (is_refused) ++refused_;
  // Past the limit a refused client may stay for the lingering close; with so many of those as well, none.
  if (is_refused && connections_.size() >= max_connections_ + kSpareFds / 2) {
    ::close(fd);
    return;
  }
  auto connection = std::make_shared<Connection>(shared_from_this(), fd, remote_address);
  epoll_event edges{};
  edges.events = EPOLLIN | EPOLLOUT | EPOLLRDHUP | EPOLLET;
  edges.data.ptr = connection.get();
  if (::epoll_ctl(events_.native_handle(), EPOLL_CTL_ADD, fd, &edges) != 0) {
    ++refused_;
    return;
  }
  connections_.insert(connection);
  open_ = connections_.size();
  if (is_refused) {
    connection->start_refusal();
  } else {
    ++accepted_;
    connection->start();
  }
}

void ServerCore::arm_events() {
  events_.async_wait(boost::asio::posix::stream_descriptor::wait_read, [self = shared_from_this()](const boost::system::error_code& ec) {
    if (ec) return;
    self->take_events();
    if (!self->is_draining_ || !self->connections_.empty()) self->arm_events();
  });
}

void ServerCore::take_events() {
  epoll_event edges[kEventsPerTurn];
  const int count = ::epoll_wait(events_.native_handle(), edges, kEventsPerTurn, 0);
  is_taking_events_ = true;
  for (int i = 0; i < count; ++i) static_cast<Connection*>(edges[i].data.ptr)->on_event(edges[i].events);
  is_taking_events_ = false;
  closed_meanwhile_.clear();
}

void ServerCore::remove(const std::shared_ptr<Connection>& connection) {
  if (is_taking_events_) closed_meanwhile_.push_back(connection);
  connections_.erase(connection);
  open_ = connections_.size();
  if (is_draining_) end_if_drained();
}

void ServerCore::arm_sweep() {
  sweep_timer_.expires_after(sweep_interval_);
  sweep_timer_.async_wait([self = shared_from_this()](const boost::system::error_code& ec) {
    if (ec) return;
    self->sweep();
    if (!self->is_draining_ || !self->connections_.empty()) self->arm_sweep();
  });
}

void ServerCore::sweep() {
  const auto now = Clock::now();
  if (now >= drain_deadline_) {
    drop_all();
    return;
  }
  if (!is_draining_)
    for (const std::size_t index : std::exchange(paused_, {})) arm_accept(index);
  const std::vector<std::shared_ptr<Connection>> all(connections_.begin(), connections_.end());  // closing changes the set
  for (const auto& connection : all) connection->check_deadline(now);
}

void ServerCore::stop(std::chrono::milliseconds deadline) {
  if (!is_started_) return;
  if (stops_.fetch_add(1) == 0) {
    post([self = shared_from_this(), deadline] { self->begin_drain(deadline); });
  } else {
    post([self = shared_from_this()] { self->drop_all(); });
  }
}

void ServerCore::begin_drain(std::chrono::milliseconds deadline) {
  for (std::size_t i = 0; i < acceptors_.size(); ++i) {
    accept_some(i);  // clients that the kernel has already let in
    boost::system::error_code ignored;
    acceptors_[i]->close(ignored);
  }
  is_draining_ = true;
  const auto now = Clock::now();
  drain_deadline_ = now + deadline;
  for (const auto& connection : connections_) connection->begin_drain(now);
  end_if_drained();
}

void ServerCore::drop_all() {
  is_draining_ = true;
  const std::vector<std::shared_ptr<Connection>> all(connections_.begin(), connections_.end());
  for (const auto& connection : all) {
    was_dropped_ = was_dropped_ || connection->has_work();
    connection->drop();
  }
  end_if_drained();
}

// Without acceptors, connections and timer the io context runs out of work.
void ServerCore::end_if_drained() {
  if (!connections_.empty()) return;
  sweep_timer_.cancel();
  events_.cancel();
}

bool ServerCore::wait() {
  const std::lock_guard lock(wait_mutex_);
  if (thread_.joinable()) thread_.join();
  return !was_dropped_;
}

std::string ServerCore::new_request_id() {
  // A random start and odd steps: unlike ids for unlike servers, no cost per request.
  id_low_ += 0x9e3779b97f4a7c15u;
  std::uint64_t mixed = id_low_;
  mixed = (mixed ^ (mixed >> 30)) * 0xbf58476d1ce4e5b9u;
  mixed = (mixed ^ (mixed >> 27)) * 0x94d049bb133111ebu;
  mixed ^= mixed >> 31;
  std::string id(32, '0');
  for (int i = 0; i < 16; ++i) {
    id[static_cast<std::size_t>(i)] = "0123456789abcdef"[(id_high_ >> (60 - 4 * i)) & 15];
    id[static_cast<std::size_t>(16 + i)] = "0123456789abcdef"[(mixed >> (60 - 4 * i)) & 15];
  }
  return id;
}

void ServerCore::record(const AccessRecord& access) {
  const int status_class = access.status == 499 ? 0 : std::clamp(access.status / 100, 0, 5);
  by_class_[status_class].fetch_add(1, std::memory_order_relaxed);
  bytes_.fetch_add(access.body_bytes, std::memory_order_relaxed);
  if (access.is_aborted) aborted_.fetch_add(1, std::memory_order_relaxed);
  if (options.on_access) options.on_access(access);
}

ServerCounters ServerCore::counters() const {
  ServerCounters out;
  out.connections_open = open_;
  out.connections_accepted = accepted_;
  out.connections_refused = refused_;
  for (int i = 0; i < 6; ++i) out.requests[i] = by_class_[i];
  out.body_bytes_sent = bytes_;
  out.timeouts = timeouts_;
  out.aborted = aborted_;
  return out;
}

Server::Server(Router router, ServerOptions options) : core_(std::make_shared<ServerCore>(std::move(router), std::move(options))) {}

Server::~Server() {
  core_->stop(std::chrono::milliseconds(0));
  core_->stop(std::chrono::milliseconds(0));
  core_->wait();
}

Result<std::uint16_t> Server::listen(const std::string& address) {
  auto parts = split_address(address);
  if (!parts) return std::move(parts.error());
  addrinfo hints{};
  hints.ai_family = AF_UNSPEC;
  hints.ai_socktype = SOCK_STREAM;
  hints.ai_flags = AI_PASSIVE | AI_NUMERICSERV;
  addrinfo* found = nullptr;
  const int code = ::getaddrinfo(parts->first.empty() ? nullptr : parts->first.c_str(), parts->second.c_str(), &hints, &found);
  if (code != 0)
    return Error{ErrorCode::kInvalidArgument, "listen address '" + address + "': " + ::gai_strerror(code)};
  const std::unique_ptr<addrinfo, void (*)(addrinfo*)> owner(found, ::freeaddrinfo);
  const int fd = ::socket(found->ai_family, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
  const int on = 1;
  if (fd >= 0) ::setsockopt(fd, SOL_SOCKET, SO_REUSEADDR, &on, sizeof on);
  if (fd < 0 || ::bind(fd, found->ai_addr, found->ai_addrlen) != 0 || ::listen(fd, 4096) != 0) {
    const int error = errno;
    if (fd >= 0) ::close(fd);
    return Error{error == EADDRINUSE ? ErrorCode::kConflict : ErrorCode::kIo, "listen address '" + address + "': " + std::strerror(error)};
  }
  auto port = core_->add_listener(fd);
  if (!port) ::close(fd);
  return port;
}

Result<std::uint16_t> Server::listen_on(int fd) { return core_->add_listener(fd); }
void Server::start() { core_->start(); }
void Server::stop(std::chrono::milliseconds deadline) { core_->stop(deadline); }
bool Server::wait() { return core_->wait(); }
ServerCounters Server::counters() const { return core_->counters(); }
const Router& Server::router() const { return core_->router; }

}  // namespace lodestone::http
