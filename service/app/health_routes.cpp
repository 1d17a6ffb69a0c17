// GET /healthz, /readyz, /metrics, /openapi.json. Statuses: 200, 400, 503.

#include <fmt/format.h>

#include <chrono>
#include <fstream>
#include <mutex>

#include "cmake/embed.h"
#include "service/app/respond.h"
#include "service/app/routes.h"

namespace lodestone {

extern const EmbeddedFile service_texts[];
extern const std::size_t service_texts_count;

namespace {

using RequestPtr = std::shared_ptr<const http::Request>;

// A tile of 17 posts, one level below a flat base, through a worker's kernels.
Result<void> compute_probe(TileMaker& maker) {
  WaveletTask task;
  task.world = {0, 0, 16, 16};
  task.posts = 17;
  task.depth = 1;
  task.method = WaveletMethod::kGsa;
  for (BandSigma& band : task.bands) band = {1.0F, 0.5F, {}};
  const PostWindow coarse = coarse_window(task);
  task.coarse_m.assign(static_cast<std::size_t>(coarse.width() * coarse.height()), 100.0F);
  return maker.ground().probe(task);
}

// Resident memory of the process in bytes.
std::uint64_t resident_bytes() {
  std::ifstream statm("/proc/self/statm");
  std::uint64_t total = 0;
  std::uint64_t resident = 0;
  statm >> total >> resident;
  return resident * 4096;
}

class MetricsText {
 public:
  void add(std::string_view type, std::string_view name, std::string_view meaning, double value, std::string_view labels = "") {
    if (name != last_name_) text_ += fmt::format("# HELP lodestone_{0} {1}\n# TYPE lodestone_{0} {2}\n", name, meaning, type);
    last_name_ = name;
    text_ += fmt::format("lodestone_{}{} {}\n", name, labels, value);
  }
  std::string text() && { return std::move(text_); }

 private:
  std::string text_;
  std::string last_name_;
};

std::string metrics_text(App& app) {
  MetricsText m;
  const auto counter = [&](std::string_view name, std::string_view meaning, std::uint64_t value, std::string_view labels = "") {
    m.add("counter", name, meaning, static_cast<double>(value), labels);
  };
  const auto gauge = [&](std::string_view name, std::string_view meaning, double value, std::string_view labels = "") {
    m.add("gauge", name, meaning, value, labels);
  };
  TileService& tiles = app.tiles();
#define LS_COUNTER(name, meaning) counter(#name, meaning, tiles.counters().name.load());
#include "service/tiles/metrics.def"
#undef LS_COUNTER
  gauge("queue_tiles", "Tiles waiting for a worker.", static_cast<double>(tiles.queue_length()));
  gauge("queue_limit_tiles", "Tiles that may wait.", app.options().queue_tiles);
  gauge("running_tiles", "Tiles in work.", static_cast<double>(tiles.running()));
  gauge("workers", "Compute threads.", tiles.workers());
  const auto memory = tiles.memory_stats();
  const auto disk = tiles.disk_stats();
  const std::string_view in_memory = "{tier=\"memory\"}";
  const std::string_view on_disk = "{tier=\"disk\"}";
  counter("cache_hits_total", "Tiles found in a cache.", memory.hits, in_memory);
  counter("cache_hits_total", "", disk.hits, on_disk);
  counter("cache_misses_total", "Look-ups that found nothing.", memory.misses, in_memory);
  counter("cache_misses_total", "", disk.misses, on_disk);
  counter("cache_evictions_total", "Entries dropped for room.", memory.evictions, in_memory);
  counter("cache_evictions_total", "", disk.evictions, on_disk);
  gauge("cache_bytes", "Bytes held.", static_cast<double>(memory.bytes), in_memory);
  gauge("cache_bytes", "", static_cast<double>(disk.bytes), on_disk);
  gauge("cache_entries", "Entries held.", static_cast<double>(memory.entries), in_memory);
  gauge("cache_entries", "", static_cast<double>(disk.entries), on_disk);
  counter("cache_writes_total", "Tiles written to disk.", disk.writes);
  counter("cache_write_errors_total", "Writes that the disk refused.", disk.write_errors);
  counter("cache_read_errors_total", "Reads that failed.", disk.read_errors);
  counter("cache_dropped_writes_total", "Writes dropped because the write queue was full.", disk.dropped_writes);
  std::uint64_t corrupt = disk.corrupt;
  const auto catalog = app.catalog();
  for (const auto& [name, layer] : catalog->layers) corrupt += layer->store().corrupt_values();
  counter("corrupt_records_total", "Stored values that failed their checksum.", corrupt);
  gauge("disk_cache_writable", "1 while the disk cache accepts writes.", disk.is_writable ? 1 : 0);
  gauge("layers", "Layers served.", static_cast<double>(catalog->layers.size()));
  if (app.public_server != nullptr) {
    const auto server = app.public_server->counters();
    counter("connections_accepted_total", "Connections accepted.", server.connections_accepted);
    counter("connections_refused_total", "Connections over the limit.", server.connections_refused);
    gauge("connections_open", "Connections open now.", static_cast<double>(server.connections_open));
    for (int status = 0; status < 6; ++status) {
      counter("http_requests_total", "Requests by status class (499: the client left).", server.requests[status],
              status == 0 ? "{class=\"499\"}" : fmt::format("{{class=\"{}xx\"}}", status));
    }
    counter("http_body_bytes_sent_total", "Body bytes sent.", server.body_bytes_sent);
    counter("http_timeouts_total", "Connections closed for slowness.", server.timeouts);
    counter("http_aborted_total", "Answers that did not reach the client whole.", server.aborted);
  }
  gauge("resident_memory_bytes", "Resident memory of the process.", static_cast<double>(resident_bytes()));
  gauge("uptime_seconds", "Time since start.", app.uptime_s());
  gauge("info", "Always 1; the labels say what runs.", 1, fmt::format("{{version=\"0.1.0\",device={}}}", http::json_string(app.device_name())));
  return std::move(m).text();
}

// Readiness by a real computation, at most once a second; requests in between get the last answer.
class Readiness {
 public:
  void answer(App& app, const RequestPtr& request, http::Responder responder) {
    if (app.is_draining) return responder.send(http::problem_response(503, "draining: the daemon is shutting down", request->raw_target, "draining"));
    {
      const std::lock_guard lock(mutex_);
      if (std::chrono::steady_clock::now() < good_until_) return send_ready(app, *request, responder);
    }
    const auto shared = std::make_shared<http::Responder>(std::move(responder));
    app.tiles().post([this, &app, request, shared](TileMaker& maker) {
      const auto ok = compute_probe(maker);
      if (!ok) return send_not_ready(*request, *shared, ok.error());
      {
        const std::lock_guard lock(mutex_);
        good_until_ = std::chrono::steady_clock::now() + std::chrono::seconds(1);
      }
      send_ready(app, *request, *shared);
    });
  }

 private:
  static void send_ready(App& app, const http::Request& request, http::Responder& responder) {
    const auto disk = app.tiles().disk_stats();
    const bool is_degraded = (app.tiles().has_disk_cache() && !disk.is_writable) || !app.catalog()->problems.empty();
    nlohmann::ordered_json json{{"status", is_degraded ? "degraded" : "ready"}, {"device", app.device_name()}, {"layers", app.catalog()->layers.size()}};
    if (is_degraded) {
      json["disk_cache_error"] = disk.last_error;
      json["problems"] = app.catalog()->problems;
    }
    send_json(request, responder, json);
  }
  static void send_not_ready(const http::Request& request, http::Responder& responder, const Error& error) {
    responder.send(http::problem_response(503, "the device does not compute: " + error.message, request.raw_target, "not_ready"));
  }

  std::mutex mutex_;  // guards good_until_
  std::chrono::steady_clock::time_point good_until_{};
};

}  // namespace

void add_health_routes(http::Router& router, App& app) {
  router.add("GET", "/healthz", [](RequestPtr request, http::Responder responder) { send_json(*request, responder, {{"status", "alive"}}); });
  const auto readiness = std::make_shared<Readiness>();
  router.add("GET", "/readyz",
             [&app, readiness](RequestPtr request, http::Responder responder) { readiness->answer(app, request, std::move(responder)); });
  router.add("GET", "/metrics", [&app](RequestPtr request, http::Responder responder) {
    http::Response response = http::text_response("text/plain; version=0.0.4; charset=utf-8", metrics_text(app));
    response.set("Cache-Control", "no-store");
    send_text(*request, responder, std::move(response));
  });
  router.add("GET", "/openapi.json", [](RequestPtr request, http::Responder responder) {
    for (std::size_t n = 0; n < service_texts_count; ++n) {
      if (service_texts[n].name != "service/app/openapi.json") continue;
      http::Response response = http::text_response("application/vnd.oai.openapi+json;version=3.1", std::string(service_texts[n].text));
      return send_text(*request, responder, std::move(response));
    }
  });
}

}  // namespace lodestone
