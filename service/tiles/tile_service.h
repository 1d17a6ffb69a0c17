#pragma once
// TileService: one finished tile for whoever asks: memory cache, disk cache, single flight, bounded priority queue, workers.

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <deque>
#include <functional>
#include <list>
#include <memory>
#include <mutex>
#include <thread>
#include <unordered_map>
#include <vector>

#include "kernels/device/device.h"
#include "kernels/types/result.h"
#include "service/tiles/tile_key.h"
#include "service/tiles/tile_maker.h"
#include "storage/cache/disk_cache.h"
#include "storage/cache/memory_cache.h"

namespace lodestone {

enum class Priority : std::uint8_t { kInteractive, kPrefetch, kPrecompute };
inline constexpr int kPriorities = 3;

// All of metrics.def.
struct TileCounters {
#define LS_COUNTER(name, meaning) std::atomic<std::uint64_t> name{0};
#include "service/tiles/metrics.def"
#undef LS_COUNTER
};

struct TileServiceOptions {
  int workers = 2;
  int batch_tiles = 4;
  int queue_tiles = 512;
  std::chrono::milliseconds timeout{60000};
  std::size_t memory_cache_bytes = std::size_t{512} << 20;
  DiskCacheOptions disk;  // budget 0: no disk cache
};

enum class TileSource : std::uint8_t { kMemory, kDisk, kComputed };

struct TileAnswer {
  Result<CachedTilePtr> tile = Error{};
  TileSource source = TileSource::kComputed;
  double queue_ms = 0, ground_ms = 0, encode_ms = 0;
};

// Thread-safe. Owns the worker threads.
class TileService {
 public:
  // device: null computes in plain C++. Errors: kDevice.
  static Result<std::unique_ptr<TileService>> create(std::shared_ptr<Device> device, const TileServiceOptions& options);
  ~TileService();  // drops what is queued (kCancelled) and waits for the workers

  using Callback = std::function<void(TileAnswer)>;
  // Tells a waiter's place; 0: the callback has already run.
  using Ticket = std::uint64_t;

  // Calls back once: at once on a memory hit or a full queue (kOverloaded), else from a worker. Never blocks on disk or compute.
  Ticket get(const TileKey& key, Priority priority, Callback callback) { return get(key, key.hash(), priority, std::move(callback)); }
  Ticket get(const TileKey& key, const CacheKey& hash, Priority priority, Callback callback);  // hash == key.hash()
  // Runs `job` on a worker before any waiting tile. Dropped when the service stops.
  void post(std::function<void(TileMaker&)> job);
  // The waiter leaves; its callback will not run any more (it may be running). When the last one of a tile leaves, queued work
  // is dropped, and running work is not started on the kernels if it has not been yet.
  void leave(Ticket ticket);

  // Waits until nothing is queued or running, at most `limit`. True if so.
  bool drain(std::chrono::milliseconds limit);

  // Drops cached tiles: all, or those of "layer" or "layer/recipe". Memory is dropped whole. Gives the number removed on disk.
  Result<std::uint64_t> purge(const std::string& tag);

  const TileCounters& counters() const { return counters_; }
  TileCounters& counters() { return counters_; }
  MemoryCache::Stats memory_stats() const { return memory_->stats(); }
  DiskCache::Stats disk_stats() const { return disk_ ? disk_->stats() : DiskCache::Stats{}; }
  bool has_disk_cache() const { return disk_ != nullptr; }
  std::size_t queue_length() const;
  std::size_t running() const { return running_.load(); }
  int workers() const { return static_cast<int>(threads_.size()); }
  // Whole seconds after which a refused client may come again: the queue's length over the recent rate, 1..60.
  int retry_after_s() const;

 private:
  struct Waiter {
    Ticket ticket;
    Callback callback;
    std::chrono::steady_clock::time_point since;
  };
  struct Flight {
    TileKey key;
    CacheKey hash;
    Priority priority = Priority::kInteractive;
    std::vector<Waiter> waiters;
    std::chrono::steady_clock::time_point queued_at;
    bool is_running = false;
  };
  using FlightPtr = std::shared_ptr<Flight>;
  struct KeyHash {
    std::size_t operator()(const CacheKey& key) const { return static_cast<std::size_t>(key.lo); }
  };

  TileService(const TileServiceOptions& options);
  void work(TileMaker& maker);
  void watch();
  struct Work {
    std::vector<FlightPtr> batch;
    std::function<void(TileMaker&)> job;
  };
  Work next_work();  // blocks; both empty at the end
  void serve(TileMaker& maker, const std::vector<FlightPtr>& batch);
  void finish(const FlightPtr& flight, const TileAnswer& answer);
  bool is_wanted(const FlightPtr& flight) const;

  const TileServiceOptions options_;
  std::unique_ptr<MemoryCache> memory_;
  std::unique_ptr<DiskCache> disk_;
  TileCounters counters_;
  std::atomic<std::size_t> running_{0};
  std::vector<std::unique_ptr<TileMaker>> makers_;
  std::vector<std::thread> threads_;

  mutable std::mutex mutex_;  // guards all below
  std::condition_variable wake_, idle_, watch_wake_;
  std::array<std::deque<FlightPtr>, kPriorities> queues_;
  std::deque<std::function<void(TileMaker&)>> jobs_;
  std::size_t queued_ = 0;
  std::unordered_map<CacheKey, FlightPtr, KeyHash> flights_;
  std::unordered_map<Ticket, FlightPtr> tickets_;
  Ticket next_ticket_ = 1;
  bool is_stopping_ = false;
  std::thread watcher_;
};

}  // namespace lodestone
