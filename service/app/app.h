#pragma once
// App: the running daemon: options, device, catalog, tile service and what the routes need. Owned by `lodestone serve`.

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <deque>
#include <functional>
#include <memory>
#include <mutex>
#include <string>
#include <thread>

#include "kernels/device/device.h"
#include "service/app/catalog.h"
#include "service/config/options.h"
#include "service/http/server.h"
#include "service/tiles/tile_service.h"

namespace lodestone {

class App {
 public:
  // Opens device (null for "host"), caches and layers. Errors: kConflict (another daemon on the data directory), kNotFound or
  // kDevice (OpenCL), kIo.
  static Result<std::unique_ptr<App>> create(const Options& options, const std::optional<std::string>& config_file);
  ~App();

  const Options& options() const { return options_; }
  std::shared_ptr<const Catalog> catalog() const { return catalog_.current(); }
  CatalogKeeper& catalog_keeper() { return catalog_; }
  TileService& tiles() { return *tiles_; }
  const Device* device() const { return device_.get(); }
  std::string device_name() const;
  double uptime_s() const;

  // Runs `job` on the admin thread, in order: file work that must not hold up the event loop.
  void run_later(std::function<void()> job);
  // Configuration file and layers anew; the old ones stay on error.
  Result<void> reload();

  // Set when the drain begins: /readyz answers 503.
  std::atomic<bool> is_draining{false};
  // The two servers, for /metrics; set by serve.
  const http::Server* public_server = nullptr;

 private:
  App(const Options& options, std::optional<std::string> config_file, FileLock lock);
  void admin_loop();

  const Options options_;
  const std::optional<std::string> config_file_;
  const std::chrono::steady_clock::time_point start_ = std::chrono::steady_clock::now();
  FileLock lock_;
  std::shared_ptr<Device> device_;
  CatalogKeeper catalog_;
  std::unique_ptr<TileService> tiles_;

  std::mutex mutex_;  // guards all below
  std::condition_variable wake_;
  std::deque<std::function<void()>> jobs_;
  bool is_stopping_ = false;
  std::thread admin_thread_;
};

// Opens the OpenCL device that the options name, with compiled programs kept below the data directory; null for "host".
Result<std::shared_ptr<Device>> open_device(const Options& options);
// Number of compute threads: options.workers, or one per CPU.
int worker_count(const Options& options);

// Routes of the public and of the admin listener. `app` must outlive the servers.
http::Router public_routes(App& app);
http::Router admin_routes(App& app);

}  // namespace lodestone
