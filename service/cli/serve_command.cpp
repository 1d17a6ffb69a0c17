// lodestone serve

#include <fmt/format.h>
#include <spdlog/sinks/basic_file_sink.h>
#include <spdlog/sinks/stdout_sinks.h>
#include <spdlog/spdlog.h>

#include <CLI/CLI.hpp>
#include <csignal>
#include <cstdio>
#include <thread>

#include "service/app/app.h"
#include "service/cli/commands.h"
#include "service/http/problem.h"

namespace lodestone {
namespace {

constexpr std::chrono::milliseconds kDrainTick{50};

// One line per request, `key=value`; what the client sent is escaped.
std::function<void(const http::AccessRecord&)> access_writer(const std::string& file) {
  if (file.empty()) return {};
  auto logger = file == "-" ? spdlog::stdout_logger_mt("access") : spdlog::basic_logger_mt("access", file);
  logger->set_pattern("%Y-%m-%dT%H:%M:%S.%eZ %v", spdlog::pattern_time_type::utc);
  logger->flush_on(spdlog::level::info);
  return [logger](const http::AccessRecord& r) {
    logger->info("id={} client={} method={} target={} status={} bytes={} ms={:.3f} aborted={} agent={}", r.request_id, r.remote_address,
                 http::json_string(r.method), http::json_string(r.target), r.status, r.body_bytes,
                 std::chrono::duration<double, std::milli>(r.duration).count(), r.is_aborted, http::json_string(r.user_agent));
  };
}

http::ServerOptions server_options(const Options& options) {
  http::ServerOptions server;
  server.max_connections = static_cast<std::size_t>(options.max_connections);
  server.header_timeout = std::chrono::seconds(options.header_timeout_s);
  server.idle_timeout = std::chrono::seconds(options.idle_timeout_s);
  server.write_timeout = std::chrono::seconds(options.write_timeout_s);
  server.cors_origins.clear();
  std::string_view rest = options.cors_origins;
  while (!rest.empty()) {
    const auto comma = rest.find(',');
    const std::string_view origin = http::trimmed(rest.substr(0, comma));
    if (!origin.empty()) server.cors_origins.emplace_back(origin);
    rest = comma == std::string_view::npos ? std::string_view() : rest.substr(comma + 1);
  }
  return server;
}

// "127.0.0.1:0" with the port that was taken.
std::string with_port(const std::string& listen, std::uint16_t port) {
  return listen.substr(0, listen.rfind(':') + 1) + std::to_string(port);
}

int run(const CommonFlags& common) {
  auto options = common.load();
  if (!options) return fail(options.error());
  auto logger = spdlog::stderr_logger_mt("lodestone");
  spdlog::set_default_logger(logger);
  spdlog::set_pattern("%Y-%m-%dT%H:%M:%S.%eZ level=%l %v", spdlog::pattern_time_type::utc);
  spdlog::set_level(spdlog::level::from_str(options->log_level));

  // Signals are waited for on this thread; every thread started from here on inherits the mask.
  sigset_t signals;
  sigemptyset(&signals);
  for (const int signal : {SIGTERM, SIGINT, SIGHUP}) sigaddset(&signals, signal);
  pthread_sigmask(SIG_BLOCK, &signals, nullptr);
  std::signal(SIGPIPE, SIG_IGN);

  auto app = App::create(*options, common.config.empty() ? std::nullopt : std::optional(common.config));
  if (!app) return fail(app.error());
  http::ServerOptions public_options = server_options(*options);
  public_options.on_access = access_writer(options->access_log);
  http::Server server(public_routes(**app), public_options);
  auto port = server.listen(options->listen);
  if (!port) return fail(port.error());
  (*app)->public_server = &server;
  http::Server admin(admin_routes(**app), server_options(*options));
  const bool has_admin = options->admin_listen != "off";
  std::uint16_t admin_port = 0;
  if (has_admin) {
    auto listening = admin.listen(options->admin_listen);
    if (!listening) return fail(listening.error());
    admin_port = *listening;
    if (options->admin_token.empty()) spdlog::warn("event=admin_locked reason=\"LODESTONE_ADMIN_TOKEN is not set\"");
    admin.start();
  }
  server.start();
  fmt::print("listening on http://{}/\n", with_port(options->listen, *port));
  if (has_admin) fmt::print("admin on http://{}/\n", with_port(options->admin_listen, admin_port));
  std::fflush(stdout);
  spdlog::info("event=started device=\"{}\" workers={} layers={}", (*app)->device_name(), (*app)->tiles().workers(), (*app)->catalog()->layers.size());

  int signal = 0;
  while (sigwait(&signals, &signal) == 0 && signal == SIGHUP) {
    (*app)->run_later([raw = app->get()] {
      if (auto ok = raw->reload(); !ok) spdlog::error("event=reload_failed error=\"{}\"", ok.error().message);
    });
  }
  // Drain: not ready at once, no new connections, what is in flight is answered; a second signal or the deadline ends it.
  spdlog::info("event=draining limit_s={}", options->drain_s);
  (*app)->is_draining = true;
  const auto limit = std::chrono::seconds(options->drain_s);
  server.stop(limit);
  admin.stop(limit);
  std::atomic<bool> is_done{false};
  std::atomic<bool> is_hurried{false};
  std::thread second_signal([&] {
    const timespec tick{0, std::chrono::nanoseconds(kDrainTick).count()};
    while (!is_done) {
      const int next = sigtimedwait(&signals, nullptr, &tick);
      if (next == SIGTERM || next == SIGINT) {
        is_hurried = true;
        server.stop(std::chrono::milliseconds(0));
        admin.stop(std::chrono::milliseconds(0));
        return;
      }
    }
  });
  const bool is_clean = server.wait();
  if (has_admin) admin.wait();
  is_done = true;
  second_signal.join();
  spdlog::info("event=stopped clean={}", is_clean && !is_hurried);
  app->reset();
  return is_clean && !is_hurried ? kDone : kFailed;
}

}  // namespace

Run declare_serve(CLI::App&, CommonFlags& common) {
  return [&common] { return run(common); };
}

}  // namespace lodestone
