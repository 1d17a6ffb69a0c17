#pragma once
// A raw socket client for the HTTP server's tests: what goes over the wire is exactly what the test wrote.

#include <arpa/inet.h>
#include <netinet/in.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <chrono>
#include <cstdint>
#include <cstdlib>
#include <string>
#include <string_view>
#include <utility>

namespace lodestone::http {

class RawClient {
 public:
  // receive_buffer_bytes: SO_RCVBUF before connecting; 0 keeps the system's.
  explicit RawClient(std::uint16_t port, int receive_buffer_bytes = 0) : fd_(::socket(AF_INET, SOCK_STREAM, 0)) {
    if (receive_buffer_bytes > 0) ::setsockopt(fd_, SOL_SOCKET, SO_RCVBUF, &receive_buffer_bytes, sizeof receive_buffer_bytes);
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_port = htons(port);
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    is_connected_ = ::connect(fd_, reinterpret_cast<sockaddr*>(&address), sizeof address) == 0;
  }
  RawClient(RawClient&& other) noexcept
      : fd_(std::exchange(other.fd_, -1)), is_connected_(other.is_connected_), pending_(std::move(other.pending_)) {}
  RawClient& operator=(RawClient&&) = delete;
  ~RawClient() { close(); }

  bool is_connected() const { return is_connected_; }
  bool send(std::string_view bytes) {
    while (!bytes.empty()) {
      const ssize_t sent = ::send(fd_, bytes.data(), bytes.size(), MSG_NOSIGNAL);
      if (sent <= 0) return false;
      bytes.remove_prefix(static_cast<std::size_t>(sent));
    }
    return true;
  }
  void finish_sending() { ::shutdown(fd_, SHUT_WR); }
  void close() {
    if (fd_ >= 0) ::close(fd_);
    fd_ = -1;
  }
  // With a reset instead of a polite end.
  void reset() {
    const linger now{1, 0};
    ::setsockopt(fd_, SOL_SOCKET, SO_LINGER, &now, sizeof now);
    close();
  }

  // One answer with its head; only the head if is_head. Empty: closed or timed out.
  std::string read_answer(bool is_head = false, int timeout_ms = 5000) {
    while (true) {
      const std::size_t end = pending_.find("\r\n\r\n");
      if (end != std::string::npos) {
        std::size_t total = end + 4;
        const std::size_t field = pending_.find("Content-Length: ");
        if (!is_head && field < end) total += std::strtoul(pending_.c_str() + field + 16, nullptr, 10);
        if (pending_.size() >= total) {
          std::string answer = pending_.substr(0, total);
          pending_.erase(0, total);
          return answer;
        }
      }
      if (!read_some(timeout_ms)) return {};
    }
  }
  // All until the server closes.
  std::string read_to_end(int timeout_ms = 5000) {
    while (read_some(timeout_ms)) {
    }
    return std::exchange(pending_, {});
  }
  // True if the server closes or resets the connection in that time.
  bool is_closed_within(int timeout_ms) {
    const auto until = std::chrono::steady_clock::now() + std::chrono::milliseconds(timeout_ms);
    while (std::chrono::steady_clock::now() < until)
      if (!read_some(50) && !timed_out_) return true;
    return false;
  }

 private:
  bool read_some(int timeout_ms) {
    pollfd waiting{fd_, POLLIN, 0};
    timed_out_ = ::poll(&waiting, 1, timeout_ms) == 0;
    if (timed_out_) return false;
    char bytes[65536];
    const ssize_t got = ::recv(fd_, bytes, sizeof bytes, 0);
    if (got <= 0) return false;
    pending_.append(bytes, static_cast<std::size_t>(got));
    return true;
  }

  int fd_;
  bool is_connected_ = false;
  bool timed_out_ = false;
  std::string pending_;
};

inline int status_of(const std::string& answer) { return answer.size() > 12 ? std::atoi(answer.c_str() + 9) : 0; }
inline std::string body_of(const std::string& answer) {
  const std::size_t end = answer.find("\r\n\r\n");
  return end == std::string::npos ? "" : answer.substr(end + 4);
}

}  // namespace lodestone::http
