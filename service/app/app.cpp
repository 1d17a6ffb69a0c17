#include "service/app/app.h"

#include <spdlog/spdlog.h>
#include <unistd.h>

#include <fstream>
#include <iterator>

namespace lodestone {
namespace {

namespace fs = std::filesystem;

// Compiled OpenCL programs below the data directory, one file per key, replaced by rename.
class ProgramFiles {
 public:
  explicit ProgramFiles(fs::path directory) : directory_(std::move(directory)) {}

  std::string load(const std::string& key) const {
    std::ifstream file(path(key), std::ios::binary);
    return {std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>()};
  }

  void save(const std::string& key, const std::string& bytes) const {
    std::error_code ignored;
    fs::create_directories(directory_, ignored);
    const fs::path temporary = path(key) + ".tmp";
    std::ofstream file(temporary, std::ios::binary | std::ios::trunc);
    file.write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
    file.close();
    if (!file) {
      spdlog::warn("event=program_not_saved key={} directory={}", key, directory_.string());
      fs::remove(temporary, ignored);
      return;
    }
    fs::rename(temporary, path(key), ignored);
  }

 private:
  std::string path(const std::string& key) const {
    std::string name;
    for (const char c : key) name += std::isalnum(static_cast<unsigned char>(c)) || c == '-' || c == '.' ? c : '_';
    return (directory_ / name).string();
  }

  const fs::path directory_;
};

}  // namespace

Result<std::shared_ptr<Device>> open_device(const Options& options) {
  if (options.device == "host") return std::shared_ptr<Device>();
  const fs::path kernels = fs::path(options.data_dir) / "kernels";
  // PoCL's own kernel cache aborts the process when a file in it is corrupt: a fresh one per process.
  std::error_code ignored;
  const fs::path cache = kernels / ("pocl-" + std::to_string(::getpid()));
  if (fs::exists(kernels, ignored)) {
    for (const auto& entry : fs::directory_iterator(kernels, ignored)) {
      const std::string name = entry.path().filename().string();
      if (name.rfind("pocl-", 0) == 0 && !fs::exists("/proc/" + name.substr(5), ignored)) fs::remove_all(entry.path(), ignored);
    }
  }
  fs::remove_all(cache, ignored);  // of a killed daemon that had the same process number
  fs::create_directories(cache, ignored);
  prepare_pocl_environment(fs::exists(cache, ignored) ? cache.string() : fs::temp_directory_path(ignored).string());
  auto files = std::make_shared<ProgramFiles>(kernels);
  DeviceOptions device;
  device.platform = options.platform;
  device.name = options.device;
  device.local_size = options.local_size;
  device.load_binary = [files](const std::string& key) { return files->load(key); };
  device.save_binary = [files](const std::string& key, const std::string& bytes) { files->save(key, bytes); };
  return Device::open(device);
}

int worker_count(const Options& options) {
  return options.workers > 0 ? options.workers : std::max(1, static_cast<int>(std::thread::hardware_concurrency()));
}

Result<std::unique_ptr<App>> App::create(const Options& options, const std::optional<std::string>& config_file) {
  std::error_code code;
  fs::create_directories(options.data_dir, code);
  if (code) return Error{ErrorCode::kIo, "data directory " + options.data_dir + " cannot be made: " + code.message()};
  auto lock = FileLock::acquire(fs::path(options.data_dir) / "lock", "data directory " + options.data_dir);
  if (!lock) return lock.error();
  std::unique_ptr<App> app(new App(options, config_file, std::move(*lock)));
  auto device = open_device(options);
  if (!device) return device.error();
  app->device_ = *device;

  TileServiceOptions tiles;
  tiles.workers = worker_count(options);
  tiles.batch_tiles = options.batch_tiles;
  tiles.queue_tiles = options.queue_tiles;
  tiles.timeout = std::chrono::seconds(options.request_timeout_s);
  tiles.memory_cache_bytes = static_cast<std::size_t>(options.memory_cache_mib) << 20;
  tiles.disk.directory = fs::path(options.data_dir) / "cache";
  tiles.disk.budget_bytes = static_cast<std::uint64_t>(options.disk_cache_mib) << 20;
  tiles.disk.kernel_hash = kernel_source_hash();
  auto service = TileService::create(app->device_, tiles);
  if (!service) return service.error();
  app->tiles_ = std::move(*service);
  if (app->tiles_->has_disk_cache()) {
    const auto stats = app->tiles_->disk_stats();
    if (!stats.is_writable) spdlog::warn("event=disk_cache_off error=\"{}\"", stats.last_error);
  }
  app->catalog_.reload_layers();
  for (const std::string& problem : app->catalog()->problems) spdlog::error("event=layer_not_opened error=\"{}\"", problem);
  app->admin_thread_ = std::thread([raw = app.get()] { raw->admin_loop(); });
  return app;
}

App::App(const Options& options, std::optional<std::string> config_file, FileLock lock)
    : options_(options), config_file_(std::move(config_file)), lock_(std::move(lock)), catalog_(options) {}

App::~App() {
  {
    const std::lock_guard lock(mutex_);
    is_stopping_ = true;
  }
  wake_.notify_all();
  if (admin_thread_.joinable()) admin_thread_.join();
  tiles_.reset();
  device_.reset();
  std::error_code ignored;
  fs::remove_all(fs::path(options_.data_dir) / "kernels" / ("pocl-" + std::to_string(::getpid())), ignored);
}

std::string App::device_name() const { return device_ ? device_->description().name : "host"; }

double App::uptime_s() const { return std::chrono::duration<double>(std::chrono::steady_clock::now() - start_).count(); }

void App::run_later(std::function<void()> job) {
  {
    const std::lock_guard lock(mutex_);
    jobs_.push_back(std::move(job));
  }
  wake_.notify_one();
}

void App::admin_loop() {
  std::unique_lock lock(mutex_);
  while (true) {
    wake_.wait(lock, [&] { return is_stopping_ || !jobs_.empty(); });
    if (jobs_.empty()) return;
    const auto job = std::move(jobs_.front());
    jobs_.pop_front();
    lock.unlock();
    job();
    lock.lock();
  }
}

Result<void> App::reload() {
  auto fresh = load_options(config_file_, {});
  if (!fresh) {
    ++tiles_->counters().config_reload_failed_total;
    spdlog::error("event=reload_refused error=\"{}\"", fresh.error().message);
    return fresh.error();
  }
  catalog_.set_recipes(fresh->recipes);
  catalog_.reload_layers();
  for (const std::string& problem : catalog()->problems) spdlog::error("event=layer_not_opened error=\"{}\"", problem);
  spdlog::info("event=reloaded layers={} recipes={}", catalog()->layers.size(), catalog()->recipes.size());
  return {};
}

}  // namespace lodestone
