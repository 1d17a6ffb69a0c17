#pragma once
// Server: HTTP/1.1 on one io thread. Start with ServerOptions and Router; connection.h has one client's side.

#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

#include "kernels/types/result.h"
#include "service/http/router.h"

namespace lodestone::http {

// One finished request, also one that could not be parsed. Views are valid during the callback; bytes as the client sent them,
// so the writer of the log escapes them. Empty method: the request line was not readable.
struct AccessRecord {
  std::string_view request_id, remote_address, method, target, user_agent, referer;
  int status = 0;  // 499: the client left before the answer
  std::uint64_t body_bytes = 0;  // sent, without the head
  std::chrono::nanoseconds duration{};  // first byte of the request to last byte of the answer
  bool is_aborted = false;              // the answer did not reach the client whole
};

struct ServerOptions {
  std::size_t max_request_line_bytes = 8 * 1024;  // longer: 414
  std::size_t max_header_bytes = 16 * 1024;       // all fields: 431
  std::size_t max_header_fields = 100;            // 431
  std::size_t max_connections = 16384;            // more: 503 and closed; lowered to what the fd limit allows
  std::chrono::milliseconds header_timeout{10'000};      // for a whole head: 408
  std::chrono::milliseconds idle_timeout{60'000};        // between requests: closed
  std::chrono::milliseconds body_timeout{30'000};        // without progress, and on average 4 KiB/s after that long: 408
  std::chrono::milliseconds write_timeout{30'000};       // without progress: closed
  std::chrono::milliseconds linger_timeout{2'000};       // reads on after a refusal, so that the client sees the answer
  std::chrono::milliseconds drain_idle_time{250};        // graceful stop: idle connections may still send for so long
  // A client that closed its sending side gets its answer. When that takes longer than this, one "100 Continue" asks
  // whether it is still there: a closed client resets the connection, and the request counts as abandoned.
  std::chrono::milliseconds half_close_probe_after{1'000};
  std::vector<std::string> cors_origins{"*"};  // "*", or a list of origins; empty: no CORS
  std::function<void(const AccessRecord&)> on_access;  // on the io thread; must not block
};

// Counters since start; open is a gauge.
struct ServerCounters {
  std::uint64_t connections_open = 0, connections_accepted = 0, connections_refused = 0;
  std::uint64_t requests[6] = {};  // by status class: [2] is 2xx; [0] is 499, the client left
  std::uint64_t body_bytes_sent = 0, timeouts = 0, aborted = 0;
};

class ServerCore;

// listen() and start() once, then stop() from any thread. Handlers run on the io thread.
class Server {
 public:
  Server(Router router, ServerOptions options);
  ~Server();  // stops at once
  Server(const Server&) = delete;
  Server& operator=(const Server&) = delete;

  // "127.0.0.1:8080", "[::1]:0", "localhost:80", ":8080" (all addresses); port 0 picks one. Gives the port. May be called
  // several times before start(). kConflict: in use; kInvalidArgument: not an address; kIo: anything else.
  Result<std::uint16_t> listen(const std::string& address);
  // Takes over a listening socket (socket activation).
  Result<std::uint16_t> listen_on(int fd);
  // Starts the io thread.
  void start();

  // Graceful: stops accepting, answers what is in flight, closes kept-alive connections; at the deadline the rest is
  // dropped. Returns at once. A second call drops everything now.
  void stop(std::chrono::milliseconds deadline);
  // Until the io thread has ended; true if nothing in flight was dropped.
  bool wait();

  ServerCounters counters() const;
  const Router& router() const;

 private:
  std::shared_ptr<ServerCore> core_;
};

}  // namespace lodestone::http
