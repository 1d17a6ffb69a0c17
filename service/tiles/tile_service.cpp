#include "service/tiles/tile_service.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

namespace lodestone {
namespace {

using Clock = std::chrono::steady_clock;

double ms_between(Clock::time_point a, Clock::time_point b) { return std::chrono::duration<double, std::milli>(b - a).count(); }

}  // namespace

Result<std::unique_ptr<TileService>> TileService::create(std::shared_ptr<Device> device, const TileServiceOptions& options) {
  std::unique_ptr<TileService> service(new TileService(options));
  for (int n = 0; n < options.workers; ++n) {
    auto ground = GroundMaker::create(device);
    if (!ground) return ground.error();
    service->makers_.push_back(std::make_unique<TileMaker>(std::move(*ground)));
  }
  for (const auto& maker : service->makers_) {
    service->threads_.emplace_back([raw = service.get(), m = maker.get()] { raw->work(*m); });
  }
  service->watcher_ = std::thread([raw = service.get()] { raw->watch(); });
  return service;
}

TileService::TileService(const TileServiceOptions& options)
    : options_(options), memory_(MemoryCache::create(options.memory_cache_bytes)) {
  if (options.disk.budget_bytes > 0) disk_ = DiskCache::open(options.disk);
}

TileService::~TileService() {
  std::vector<FlightPtr> dropped;
  {
    const std::lock_guard lock(mutex_);
    is_stopping_ = true;
    for (auto& queue : queues_) {
      dropped.insert(dropped.end(), queue.begin(), queue.end());
      queue.clear();
    }
    queued_ = 0;
  }
  wake_.notify_all();
  watch_wake_.notify_all();
  TileAnswer stopped;
  stopped.tile = Error{ErrorCode::kCancelled, "the service is stopping"};
  for (const FlightPtr& flight : dropped) finish(flight, stopped);
  for (std::thread& thread : threads_) thread.join();
  if (watcher_.joinable()) watcher_.join();
}

void TileService::post(std::function<void(TileMaker&)> job) {
  {
    const std::lock_guard lock(mutex_);
    jobs_.push_back(std::move(job));
  }
  wake_.notify_one();
}

TileService::Ticket TileService::get(const TileKey& key, const CacheKey& hash, Priority priority, Callback callback) {
  TileAnswer answer;
  if (CachedTilePtr hit = memory_->get(hash)) {
    answer.tile = std::move(hit);
    answer.source = TileSource::kMemory;
    callback(std::move(answer));
    return 0;
  }
  Ticket ticket = 0;
  {
    const std::lock_guard lock(mutex_);
    const Clock::time_point now = Clock::now();
    FlightPtr flight;
    if (const auto found = flights_.find(hash); found != flights_.end()) {
      flight = found->second;
      ++counters_.tiles_joined_total;
      if (priority < flight->priority && !flight->is_running) {
        // A waiting precompute tile that somebody now looks at moves up.
        auto& queue = queues_[static_cast<std::size_t>(flight->priority)];
        queue.erase(std::find(queue.begin(), queue.end(), flight));
        flight->priority = priority;
        queues_[static_cast<std::size_t>(priority)].push_back(flight);
      }
    } else if (is_stopping_ || queued_ >= static_cast<std::size_t>(options_.queue_tiles)) {
      ++counters_.tiles_refused_total;
    } else {
      flight = std::make_shared<Flight>();
      flight->key = key;
      flight->hash = hash;
      flight->priority = priority;
      flight->queued_at = now;
      flights_.emplace(hash, flight);
      queues_[static_cast<std::size_t>(priority)].push_back(flight);
      ++queued_;
    }
    if (flight) {
      ticket = next_ticket_++;
      flight->waiters.push_back({ticket, std::move(callback), now});
      tickets_.emplace(ticket, flight);
    }
  }
  if (ticket == 0) {
    answer.tile = Error{ErrorCode::kOverloaded, fmt::format("{} tiles are waiting already, the limit; try again later", options_.queue_tiles)};
    callback(std::move(answer));
    return 0;
  }
  wake_.notify_one();
  return ticket;
}

void TileService::leave(Ticket ticket) {
  const std::lock_guard lock(mutex_);
  const auto found = tickets_.find(ticket);
  if (found == tickets_.end()) return;
  const FlightPtr flight = found->second;
  tickets_.erase(found);
  std::erase_if(flight->waiters, [&](const Waiter& w) { return w.ticket == ticket; });
  if (!flight->waiters.empty()) return;
  ++counters_.tiles_cancelled_total;
  flights_.erase(flight->hash);  // the next one who asks starts anew
  if (!flight->is_running) {
    auto& queue = queues_[static_cast<std::size_t>(flight->priority)];
    queue.erase(std::find(queue.begin(), queue.end(), flight));
    --queued_;
    idle_.notify_all();
  }
}

TileService::Work TileService::next_work() {
  std::unique_lock lock(mutex_);
  wake_.wait(lock, [&] { return is_stopping_ || queued_ > 0 || !jobs_.empty(); });
  Work work;
  if (is_stopping_) return work;
  if (!jobs_.empty()) {
    work.job = std::move(jobs_.front());
    jobs_.pop_front();
    return work;
  }
  std::vector<FlightPtr>& batch = work.batch;
  // The other workers get their share before this one takes a second tile.
  const std::size_t share = (queued_ + threads_.size() - 1) / std::max<std::size_t>(1, threads_.size());
  const std::size_t most = std::min<std::size_t>(static_cast<std::size_t>(options_.batch_tiles), std::max<std::size_t>(1, share));
  for (auto& queue : queues_) {
    while (!queue.empty() && batch.size() < most) {
      batch.push_back(queue.front());
      batch.back()->is_running = true;
      queue.pop_front();
      --queued_;
    }
    if (!batch.empty()) break;  // one priority per batch: a looked-at tile never waits for a precomputed one
  }
  running_ += batch.size();
  return work;
}

bool TileService::is_wanted(const FlightPtr& flight) const {
  const std::lock_guard lock(mutex_);
  return !flight->waiters.empty();
}

void TileService::finish(const FlightPtr& flight, const TileAnswer& answer) {
  std::vector<Waiter> waiters;
  {
    const std::lock_guard lock(mutex_);
    waiters.swap(flight->waiters);
    for (const Waiter& waiter : waiters) tickets_.erase(waiter.ticket);
    if (const auto found = flights_.find(flight->hash); found != flights_.end() && found->second == flight) flights_.erase(found);
  }
  for (Waiter& waiter : waiters) waiter.callback(answer);
}

void TileService::serve(TileMaker& maker, const std::vector<FlightPtr>& batch) {
  const Clock::time_point start = Clock::now();
  std::vector<FlightPtr> missing;
  for (const FlightPtr& flight : batch) {
    if (!is_wanted(flight)) continue;
    if (disk_) {
      if (CachedTilePtr hit = disk_->get(flight->hash)) {
        memory_->put(flight->hash, hit);
        TileAnswer answer;
        answer.tile = std::move(hit);
        answer.source = TileSource::kDisk;
        answer.queue_ms = ms_between(flight->queued_at, start);
        finish(flight, answer);
        continue;
      }
    }
    missing.push_back(flight);
  }
  if (missing.empty()) return;
  std::vector<TileKey> keys;
  for (const FlightPtr& flight : missing) keys.push_back(flight->key);
  ++counters_.kernel_batches_total;
  auto made = maker.make(keys);
  for (std::size_t n = 0; n < missing.size(); ++n) {
    TileAnswer answer;
    answer.queue_ms = ms_between(missing[n]->queued_at, start);
    if (made[n]) {
      ++counters_.tiles_generated_total;
      answer.ground_ms = made[n]->ground_ms;
      answer.encode_ms = made[n]->encode_ms;
      counters_.ground_microseconds_total += static_cast<std::uint64_t>(made[n]->ground_ms * 1000);
      counters_.encode_microseconds_total += static_cast<std::uint64_t>(made[n]->encode_ms * 1000);
      answer.tile = made[n]->tile;
      memory_->put(missing[n]->hash, made[n]->tile);
      if (disk_) disk_->put(missing[n]->hash, missing[n]->key.tag(), made[n]->tile);
    } else {
      ++counters_.tiles_failed_total;
      answer.tile = made[n].error();
    }
    finish(missing[n], answer);
  }
}

void TileService::work(TileMaker& maker) {
  for (Work work = next_work(); work.job || !work.batch.empty(); work = next_work()) {
    if (work.job) {
      work.job(maker);
      continue;
    }
    serve(maker, work.batch);
    running_ -= work.batch.size();
    const std::lock_guard lock(mutex_);
    idle_.notify_all();
  }
}

void TileService::watch() {
  std::unique_lock lock(mutex_);
  while (!is_stopping_) {
    watch_wake_.wait_for(lock, std::min<std::chrono::milliseconds>(options_.timeout, std::chrono::milliseconds(250)));
    const Clock::time_point now = Clock::now();
    std::vector<Waiter> late;
    for (auto& [hash, flight] : flights_) {
      auto& waiters = flight->waiters;
      const auto first_late = std::stable_partition(waiters.begin(), waiters.end(),
                                                    [&](const Waiter& w) { return now - w.since < options_.timeout; });
      std::move(first_late, waiters.end(), std::back_inserter(late));
      waiters.erase(first_late, waiters.end());
    }
    for (const Waiter& waiter : late) tickets_.erase(waiter.ticket);
    // Work that nobody waits for any more is dropped where it still waits for a worker.
    for (auto& queue : queues_) {
      for (auto it = queue.begin(); it != queue.end();) {
        if ((*it)->waiters.empty()) {
          ++counters_.tiles_cancelled_total;
          flights_.erase((*it)->hash);
          it = queue.erase(it);
          --queued_;
        } else {
          ++it;
        }
      }
    }
    if (late.empty()) continue;
    counters_.tiles_timed_out_total += late.size();
    lock.unlock();
    TileAnswer answer;
    answer.tile = Error{ErrorCode::kOverloaded, fmt::format("the tile was not ready within {} ms", options_.timeout.count())};
    for (Waiter& waiter : late) waiter.callback(answer);
    lock.lock();
  }
}

bool TileService::drain(std::chrono::milliseconds limit) {
  std::unique_lock lock(mutex_);
  return idle_.wait_for(lock, limit, [&] { return queued_ == 0 && running_.load() == 0; });
}

Result<std::uint64_t> TileService::purge(const std::string& tag) {
  memory_->clear();
  if (!disk_) return std::uint64_t{0};
  disk_->flush();
  return disk_->purge(tag);
}

std::size_t TileService::queue_length() const {
  const std::lock_guard lock(mutex_);
  return queued_;
}

int TileService::retry_after_s() const {
  const double generated = static_cast<double>(std::max<std::uint64_t>(1, counters_.tiles_generated_total.load()));
  const double tile_s = static_cast<double>(counters_.ground_microseconds_total + counters_.encode_microseconds_total) / generated * 1e-6;
  const double wait_s = static_cast<double>(queue_length()) * std::max(tile_s, 1e-4) / std::max<std::size_t>(1, threads_.size());
  return std::clamp(static_cast<int>(std::ceil(wait_s)), 1, 60);
}

}  // namespace lodestone
