// The server over real sockets: limits, order, slow and vanishing clients, graceful stop.

#include "service/http/server.h"

#include <gtest/gtest.h>

#include <atomic>
#include <condition_variable>
#include <mutex>
#include <nlohmann/json.hpp>
#include <thread>

#include "tests/service/http_client.h"

namespace lodestone::http {
namespace {

using namespace std::chrono_literals;

constexpr const char* kGet = "GET /small HTTP/1.1\r\nHost: x\r\n\r\n";
constexpr std::size_t kBigBytes = 32 << 20;

std::string get(const std::string& path, const std::string& fields = "") {
  return "GET " + path + " HTTP/1.1\r\nHost: x\r\n" + fields + "\r\n";
}

// A server with the routes that the tests need, and what it reported.
class ServerTest : public testing::Test {
 protected:
  struct Logged {
    std::string method, target, id, agent;
    int status;
    bool is_aborted;
    std::uint64_t bytes;
  };

  void start() {
    options_.on_access = [this](const AccessRecord& r) {
      const std::lock_guard lock(mutex_);
      log_.push_back({std::string(r.method), std::string(r.target), std::string(r.request_id), std::string(r.user_agent), r.status, r.is_aborted, r.body_bytes});
      changed_.notify_all();
    };
    Router router;
    router.add("GET", "/small", [](auto, Responder responder) { responder.send(text_response("text/plain", "small")); });
    router.add("GET", "/echo/{name}", [](std::shared_ptr<const Request> request, Responder responder) {
      responder.send(text_response("text/plain", std::string(request->param("name"))));
    });
    router.add("GET", "/big", [this](auto, Responder responder) {
      Response response;
      response.content_type = "application/octet-stream";
      response.body = Body::shared<std::string>(big_);
      responder.send(std::move(response));
    });
    router.add("GET", "/later", [this](auto, Responder responder) { add_worker([this, r = std::move(responder)]() mutable {
      std::this_thread::sleep_for(later_.load());
      r.send(text_response("text/plain", "later"));
    }); });
    router.add("GET", "/never", [this](auto, Responder responder) {
      responder.on_abandoned([this] { notify([this] { ++abandoned_; }); });
      const std::lock_guard lock(mutex_);
      held_.push_back(std::move(responder));
      changed_.notify_all();
    });
    router.add("GET", "/forgets", [](auto, Responder) {});
    router.add("GET", "/throws", [](auto, Responder) { throw std::runtime_error("oops"); });
    router.add("GET", "/split", [](auto, Responder responder) {
      responder.send(text_response("text/plain", "x").set("X-Split", "a\r\nEvil: yes"));
    });
    router.add("GET", "/same", [](auto, Responder responder) {
      Response response;
      response.status = 304;
      responder.send(std::move(response.set("ETag", "\"1\"")));
    });
    router.add("POST", "/upload", [](std::shared_ptr<const Request> request, Responder responder) {
      responder.send(text_response("text/plain", request->body));
    }, {.max_body_bytes = 1000});
    server_ = std::make_unique<Server>(std::move(router), options_);
    auto port = server_->listen("127.0.0.1:0");
    ASSERT_TRUE(port) << port.error().message;
    port_ = *port;
    server_->start();
  }
  void TearDown() override {
    server_.reset();
    held_.clear();
    for (std::thread& worker : workers_) worker.join();
  }

  void add_worker(auto task) {
    const std::lock_guard lock(mutex_);
    workers_.emplace_back(std::move(task));
  }
  void notify(auto change) {
    const std::lock_guard lock(mutex_);
    change();
    changed_.notify_all();
  }
  bool wait_for(auto condition, std::chrono::milliseconds time = 5s) {
    std::unique_lock lock(mutex_);
    return changed_.wait_for(lock, time, condition);
  }
  // The answer to one request on its own connection.
  std::string answer_to(const std::string& bytes, bool is_head = false) {
    RawClient client(port_);
    client.send(bytes);
    return client.read_answer(is_head);
  }

  ServerOptions options_;
  const std::shared_ptr<const std::string> big_ = std::make_shared<const std::string>(kBigBytes, 'b');
  std::atomic<std::chrono::milliseconds> later_{50ms};
  std::unique_ptr<Server> server_;
  std::uint16_t port_ = 0;
  std::mutex mutex_;  // guards all below
  std::condition_variable changed_;
  std::vector<Logged> log_;
  std::vector<Responder> held_;
  std::vector<std::thread> workers_;
  int abandoned_ = 0;
};

TEST_F(ServerTest, AnswersWithTheFieldsThatEveryAnswerHas) {
  start();
  const std::string answer = answer_to(kGet);
  EXPECT_EQ(answer.substr(0, 17), "HTTP/1.1 200 OK\r\n");
  for (const char* field : {"\r\nServer: Lodestone\r\n", "\r\nDate: ", " GMT\r\n", "\r\nContent-Length: 5\r\n", "\r\nX-Content-Type-Options: nosniff\r\n",
                            "\r\nContent-Type: text/plain\r\n", "\r\nAccess-Control-Allow-Origin: *\r\n", "\r\nX-Request-Id: "})
    EXPECT_NE(answer.find(field), std::string::npos) << field << answer;
  EXPECT_EQ(answer.find("Connection: close"), std::string::npos);
  EXPECT_EQ(body_of(answer), "small");
}

TEST_F(ServerTest, AnswersHeadWithTheLengthAlone) {
  start();
  RawClient client(port_);
  client.send("HEAD /small HTTP/1.1\r\nHost: x\r\n\r\n");
  const std::string head = client.read_answer(true);
  EXPECT_NE(head.find("Content-Length: 5\r\n"), std::string::npos);
  client.send(get("/same"));  // nothing may lie between the two answers
  const std::string same = client.read_answer();
  EXPECT_EQ(status_of(same), 304);
  EXPECT_NE(same.find("ETag: \"1\"\r\n"), std::string::npos);
  EXPECT_EQ(same.find("\r\nContent-Length:"), std::string::npos);
  client.send(kGet);
  EXPECT_EQ(body_of(client.read_answer()), "small");
}

TEST_F(ServerTest, TellsWrongMethodsAndPathsApart) {
  start();
  const std::string wrong = answer_to("POST /small HTTP/1.1\r\nHost: x\r\n\r\n");
  EXPECT_EQ(status_of(wrong), 405);
  EXPECT_NE(wrong.find("\r\nAllow: GET, HEAD, OPTIONS\r\n"), std::string::npos);
  EXPECT_EQ(status_of(answer_to("TRACE /small HTTP/1.1\r\nHost: x\r\n\r\n")), 405);
  EXPECT_EQ(status_of(answer_to("BREW /small HTTP/1.1\r\nHost: x\r\n\r\n")), 501);
  EXPECT_EQ(status_of(answer_to("CONNECT a:1 HTTP/1.1\r\nHost: x\r\n\r\n")), 501);
  EXPECT_EQ(status_of(answer_to(get("/nothing"))), 404);
  EXPECT_EQ(status_of(answer_to(get("/small/"))), 404);
  EXPECT_EQ(status_of(answer_to("GET http://x/small HTTP/1.1\r\nHost: x\r\n\r\n")), 200);
  for (const char* path : {"/../small", "/%2e%2e%2fsmall", "/..%5c", "//small", "/small%00", "/%"})
    EXPECT_EQ(status_of(answer_to(get(path))), 400) << path;
  const std::string problem = answer_to(get("/no%1b[31m\"x"));
  EXPECT_EQ(status_of(problem), 400);
  EXPECT_NE(problem.find("Content-Type: application/problem+json"), std::string::npos);
  EXPECT_EQ(nlohmann::json::parse(body_of(problem))["status"], 400);
}

TEST_F(ServerTest, AnswersPreflights) {
  options_.cors_origins = {"https://good.example"};
  start();
  const std::string ask = "OPTIONS /small HTTP/1.1\r\nHost: x\r\nAccess-Control-Request-Method: GET\r\nOrigin: ";
  const std::string good = answer_to(ask + "https://good.example\r\n\r\n");
  EXPECT_EQ(status_of(good), 204);
  EXPECT_NE(good.find("Access-Control-Allow-Origin: https://good.example\r\n"), std::string::npos);
  EXPECT_NE(good.find("Access-Control-Allow-Methods: GET, HEAD, OPTIONS\r\n"), std::string::npos);
  const std::string foreign = answer_to(ask + "https://evil.example\r\n\r\n");
  EXPECT_EQ(status_of(foreign), 204);
  EXPECT_EQ(foreign.find("Access-Control-Allow-Origin"), std::string::npos);
  EXPECT_NE(answer_to(kGet).find("\r\nVary: Origin\r\n"), std::string::npos);
  EXPECT_EQ(status_of(answer_to("OPTIONS * HTTP/1.1\r\nHost: x\r\n\r\n")), 204);
  EXPECT_EQ(status_of(answer_to("OPTIONS /nothing HTTP/1.1\r\nHost: x\r\n\r\n")), 404);
}

TEST_F(ServerTest, RefusesWhatIsTooLargeOrMalformed) {
  start();
  EXPECT_EQ(status_of(answer_to(get("/" + std::string(9000, 'a')))), 414);
  EXPECT_EQ(status_of(answer_to(std::string(9000, 'a'))), 414);
  EXPECT_EQ(status_of(answer_to(get("/" + std::string(8000, 'a')))), 404);
  EXPECT_EQ(status_of(answer_to(get("/small", "X: " + std::string(20000, 'a') + "\r\n"))), 431);
  std::string fields;
  for (int i = 0; i < 99; ++i) fields += "X" + std::to_string(i) + ": y\r\n";
  EXPECT_EQ(status_of(answer_to(get("/small", fields))), 200);
  EXPECT_EQ(status_of(answer_to(get("/small", fields + fields))), 431);
  EXPECT_EQ(status_of(answer_to("GET /small HTTP/1.1\r\n\r\n")), 400);
  EXPECT_EQ(status_of(answer_to(get("/small", "Host: y\r\n"))), 400);
  EXPECT_EQ(status_of(answer_to("\x16\x03\x01")), 400);
  EXPECT_EQ(status_of(answer_to("PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n")), 505);
  RawClient client(port_);
  client.send("nonsense\r\n\r\n");
  const std::string answer = client.read_to_end();  // and the connection is closed
  EXPECT_EQ(status_of(answer), 400);
  EXPECT_NE(answer.find("Connection: close"), std::string::npos);
}

TEST_F(ServerTest, TakesBodiesUpToTheLimitOfTheRoute) {
  start();
  const std::string post = "POST /upload HTTP/1.1\r\nHost: x\r\n";
  EXPECT_EQ(body_of(answer_to(post + "Content-Length: 5\r\n\r\nhello")), "hello");
  EXPECT_EQ(body_of(answer_to(post + "Transfer-Encoding: chunked\r\n\r\n5\r\nhello\r\n0\r\n\r\n")), "hello");
  EXPECT_EQ(status_of(answer_to(post + "Content-Length: 1000\r\n\r\n" + std::string(1000, 'x'))), 200);
  EXPECT_EQ(status_of(answer_to(post + "Content-Length: 1001\r\n\r\n" + std::string(1001, 'x'))), 413);
  EXPECT_EQ(status_of(answer_to(post + "Transfer-Encoding: chunked\r\n\r\n3e9\r\n" + std::string(1001, 'x'))), 413);
  EXPECT_EQ(status_of(answer_to(post + "Content-Length: 3\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n")), 400);
  EXPECT_EQ(status_of(answer_to(post + "Transfer-Encoding: chunked\r\n\r\nzz\r\n")), 400);
  EXPECT_EQ(status_of(answer_to(post + "Content-Encoding: gzip\r\nContent-Length: 1\r\n\r\nx")), 415);
  EXPECT_EQ(status_of(answer_to("GET /small HTTP/1.1\r\nHost: x\r\nContent-Length: 3\r\n\r\nabc")), 413);
  // A large refused upload still reads its answer.
  EXPECT_EQ(status_of(answer_to(post + "Content-Length: 5000000\r\n\r\n" + std::string(5000000, 'x'))), 413);
}

TEST_F(ServerTest, HonoursExpectContinue) {
  start();
  const std::string post = "POST /upload HTTP/1.1\r\nHost: x\r\nExpect: 100-continue\r\nContent-Length: ";
  RawClient client(port_);
  client.send(post + "5\r\n\r\n");
  EXPECT_EQ(client.read_answer(), "HTTP/1.1 100 Continue\r\n\r\n");
  client.send("hello");
  EXPECT_EQ(body_of(client.read_answer()), "hello");
  client.send(post + "5000\r\n\r\n");  // the body is never sent
  EXPECT_EQ(status_of(client.read_answer()), 413);
  EXPECT_TRUE(client.is_closed_within(5000));
}

TEST_F(ServerTest, AnswersFiftyPipelinedRequestsInOrder) {
  start();
  std::string bytes;
  for (int i = 0; i < 50; ++i) bytes += get(i % 10 == 3 ? "/later" : "/echo/n" + std::to_string(i));
  later_ = 5ms;
  RawClient client(port_);
  client.send(bytes);
  client.finish_sending();
  for (int i = 0; i < 50; ++i) EXPECT_EQ(body_of(client.read_answer()), i % 10 == 3 ? "later" : "n" + std::to_string(i));
  EXPECT_TRUE(client.is_closed_within(5000));
}

TEST_F(ServerTest, AnswersAfterAHalfClose) {
  start();
  for (const char* path : {"/small", "/later", "/big"}) {
    RawClient client(port_);
    client.send(get(path));
    client.finish_sending();
    const std::string answer = client.read_to_end();
    EXPECT_EQ(status_of(answer), 200) << path;
    if (std::string(path) == "/big") { EXPECT_EQ(body_of(answer).size(), kBigBytes); }
  }
}

TEST_F(ServerTest, AsksAHalfClosedClientWhetherItIsThere) {
  options_.half_close_probe_after = 40ms;
  start();
  later_ = 400ms;
  RawClient client(port_);
  client.send(get("/later"));
  client.finish_sending();
  EXPECT_EQ(client.read_answer(), "HTTP/1.1 100 Continue\r\n\r\n");
  EXPECT_EQ(body_of(client.read_answer()), "later");
}

TEST_F(ServerTest, TellsTheHandlerThatTheClientLeft) {
  options_.half_close_probe_after = 40ms;
  start();
  RawClient polite(port_), rude(port_);
  polite.send(get("/never"));
  rude.send(get("/never"));
  ASSERT_TRUE(wait_for([&] { return held_.size() == 2; }));
  rude.reset();
  EXPECT_TRUE(wait_for([&] { return abandoned_ == 1; }));
  polite.close();
  EXPECT_TRUE(wait_for([&] { return abandoned_ == 2 && log_.size() == 2; }));
  for (const Logged& line : log_) EXPECT_TRUE(line.status == 499 && line.is_aborted && line.target == "/never");
  held_[0].send(text_response("text/plain", "nobody reads it"));
  bool ran = false;
  held_[1].on_abandoned([&] { ran = true; });  // late registration runs at once
  EXPECT_TRUE(ran);
  EXPECT_EQ(server_->counters().requests[0], 2u);
  EXPECT_EQ(status_of(answer_to(kGet)), 200);
}

TEST_F(ServerTest, AnswersForHandlersThatFail) {
  start();
  EXPECT_EQ(status_of(answer_to(get("/forgets"))), 500);
  EXPECT_EQ(status_of(answer_to(get("/throws"))), 500);
  const std::string split = answer_to(get("/split"));
  EXPECT_NE(split.find("X-Split: a??Evil: yes\r\n"), std::string::npos);
}

TEST_F(ServerTest, ClosesSlowHeadersAndIdleConnections) {
  options_.header_timeout = 150ms;
  options_.idle_timeout = 300ms;
  start();
  RawClient silent(port_), slow(port_), kept(port_);
  slow.send("GET / HT");
  kept.send(kGet);
  EXPECT_EQ(status_of(kept.read_answer()), 200);
  EXPECT_FALSE(kept.is_closed_within(150));
  EXPECT_TRUE(kept.is_closed_within(2000));
  EXPECT_EQ(status_of(slow.read_answer()), 408);
  EXPECT_TRUE(slow.is_closed_within(2000));
  EXPECT_TRUE(silent.is_closed_within(2000));
  EXPECT_EQ(server_->counters().timeouts, 1u);
}

TEST_F(ServerTest, ClosesSlowBodies) {
  options_.body_timeout = 150ms;
  start();
  EXPECT_EQ(status_of(answer_to("POST /upload HTTP/1.1\r\nHost: x\r\nContent-Length: 10\r\n\r\nabc")), 408);
  RawClient dripping(port_);
  dripping.send("POST /upload HTTP/1.1\r\nHost: x\r\nContent-Length: 100\r\n\r\n");
  bool is_open = true;
  for (int i = 0; i < 40 && is_open; ++i) is_open = dripping.send("x") && !dripping.is_closed_within(50);
  EXPECT_FALSE(is_open);
}

TEST_F(ServerTest, ClosesReadersThatStopReading) {
  options_.write_timeout = 200ms;
  start();
  RawClient stuck(port_, 4096);
  stuck.send(get("/big"));
  ASSERT_TRUE(wait_for([&] { return !log_.empty(); }));
  EXPECT_TRUE(log_[0].is_aborted);
  EXPECT_LT(log_[0].bytes, kBigBytes);
  EXPECT_TRUE(stuck.is_closed_within(5000));
  EXPECT_EQ(server_->counters().connections_open, 0u);
}

TEST_F(ServerTest, ServesOthersWhileAThousandClientsAreSlow) {
  start();
  std::vector<std::unique_ptr<RawClient>> slow;
  for (int i = 0; i < 1000; ++i) {
    slow.push_back(std::make_unique<RawClient>(port_, 4096));
    ASSERT_TRUE(slow.back()->is_connected()) << i;
    slow.back()->send(i % 2 == 0 ? "GET /sm" : get("/big"));
  }
  const auto from = std::chrono::steady_clock::now();
  for (int i = 0; i < 50; ++i) EXPECT_EQ(status_of(answer_to(kGet)), 200);
  EXPECT_LT(std::chrono::steady_clock::now() - from, 5s);
  EXPECT_EQ(status_of(answer_to(get("/later"))), 200);
  EXPECT_GE(server_->counters().connections_open, 1000u);
}

TEST_F(ServerTest, RefusesConnectionsPastTheLimit) {
  options_.max_connections = 3;
  start();
  std::vector<std::unique_ptr<RawClient>> clients;
  for (int i = 0; i < 3; ++i) {
    clients.push_back(std::make_unique<RawClient>(port_));
    clients.back()->send(kGet);
    EXPECT_EQ(status_of(clients.back()->read_answer()), 200);
  }
  RawClient extra(port_);
  extra.send(kGet);
  const std::string answer = extra.read_to_end();
  EXPECT_EQ(status_of(answer), 503);
  EXPECT_NE(answer.find("\r\nRetry-After: "), std::string::npos);
  extra.close();
  clients.pop_back();
  int status = 0;
  for (int i = 0; i < 100 && status != 200; ++i) {
    std::this_thread::sleep_for(20ms);
    status = status_of(answer_to(kGet));
  }
  EXPECT_EQ(status, 200);
  EXPECT_GE(server_->counters().connections_refused, 1u);
}

TEST_F(ServerTest, KeepsOldClientsAliveOnlyWhenTheyAsk) {
  start();
  RawClient old(port_);
  old.send("GET /small HTTP/1.0\r\n\r\n");
  EXPECT_EQ(body_of(old.read_to_end()), "small");
  RawClient kept(port_);
  kept.send("GET /small HTTP/1.0\r\nConnection: keep-alive\r\n\r\n");
  EXPECT_NE(kept.read_answer().find("Connection: keep-alive"), std::string::npos);
  kept.send("GET /small HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n");
  EXPECT_EQ(body_of(kept.read_to_end()), "small");
}

TEST_F(ServerTest, LogsEveryRequestWithItsTrace) {
  start();
  const std::string trace = "4bf92f3577b34da6a3ce929d0e0e4736";
  const std::string answer = answer_to(get("/small", "User-Agent: a\x1b-is-not-allowed\r\n"));
  EXPECT_EQ(status_of(answer), 400);
  EXPECT_NE(answer_to(get("/small", "User-Agent: me\r\ntraceparent: 00-" + trace + "-00f067aa0ba902b7-01\r\n")).find("X-Request-Id: " + trace), std::string::npos);
  answer_to("nonsense\r\n\r\n");
  ASSERT_TRUE(wait_for([&] { return log_.size() == 3; }));
  EXPECT_EQ(log_[0].target, "/small");
  EXPECT_EQ(log_[1].id, trace);
  EXPECT_EQ(log_[1].agent, "me");
  EXPECT_EQ(log_[1].bytes, 5u);
  EXPECT_EQ(log_[2].status, 400);
  const auto counters = server_->counters();
  EXPECT_EQ(counters.requests[2], 1u);
  EXPECT_EQ(counters.requests[4], 2u);
  EXPECT_EQ(counters.connections_accepted, 3u);
}

TEST_F(ServerTest, StopsGracefullyWithWhatIsInFlightAnswered) {
  start();
  later_ = 300ms;
  RawClient idle(port_), busy(port_), fresh(port_);
  idle.send(kGet);
  EXPECT_EQ(status_of(idle.read_answer()), 200);
  busy.send(get("/later"));
  std::this_thread::sleep_for(50ms);
  server_->stop(5s);
  std::this_thread::sleep_for(50ms);
  EXPECT_FALSE(RawClient(port_).is_connected());
  fresh.send(kGet);  // a request that was on its way
  EXPECT_NE(fresh.read_answer().find("Connection: close"), std::string::npos);
  EXPECT_NE(busy.read_answer().find("Connection: close"), std::string::npos);
  EXPECT_TRUE(idle.is_closed_within(2000));
  EXPECT_TRUE(server_->wait());
  EXPECT_EQ(server_->counters().connections_open, 0u);
}

TEST_F(ServerTest, StopsAtTheDeadlineOrTheSecondCall) {
  for (const bool is_second_call : {true, false}) {
    start();
    RawClient client(port_);
    client.send(get("/never"));
    ASSERT_TRUE(wait_for([&] { return held_.size() == 1; }));
    const auto from = std::chrono::steady_clock::now();
    server_->stop(is_second_call ? 60s : 200ms);
    if (is_second_call) server_->stop(60s);
    EXPECT_FALSE(server_->wait());
    EXPECT_LT(std::chrono::steady_clock::now() - from, 5s);
    EXPECT_TRUE(client.is_closed_within(1000));
    server_.reset();
    held_.clear();  // answers after the end go nowhere
  }
  EXPECT_EQ(abandoned_, 2);
}

TEST_F(ServerTest, NamesBadListenAddresses) {
  start();
  Server other(Router(), {});
  EXPECT_EQ(other.listen("127.0.0.1:" + std::to_string(port_)).error().code, ErrorCode::kConflict);
  for (const char* bad : {"127.0.0.1", "127.0.0.1:", "127.0.0.1:x", "127.0.0.1:65536", "::1:80", "[]:1", "no host:1"})
    EXPECT_EQ(other.listen(bad).error().code, ErrorCode::kInvalidArgument) << bad;
  EXPECT_TRUE(other.listen("localhost:0"));
}

TEST_F(ServerTest, ManyClientsAndWorkersAtOnce) {
  start();
  later_ = 1ms;
  std::vector<std::thread> clients;
  std::atomic<int> good{0};
  for (int t = 0; t < 8; ++t)
    clients.emplace_back([&, t] {
      for (int i = 0; i < 10; ++i) {
        RawClient client(port_);
        for (int k = 0; k < 4; ++k) {
          client.send(get(k % 2 == 0 ? "/later" : "/small"));
          if (i % 5 == 4 && t % 2 == 0 && k == 2) {
            client.reset();
            break;
          }
          if (status_of(client.read_answer()) == 200) ++good;
        }
      }
    });
  for (std::thread& client : clients) client.join();
  EXPECT_EQ(good, 8 * 10 * 4 - 4 * 2 * 2);
}

}  // namespace
}  // namespace lodestone::http
