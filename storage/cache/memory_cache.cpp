// S3-FIFO after Yang et al., "FIFO queues are all you need for cache eviction" (SOSP 2023), algorithm 1: a small probation queue of a
// tenth of the bytes, a main queue for what was asked for again, and a ghost queue of the keys that left probation lately.
// We count bytes where the paper counts objects, and one later hit (not two) is enough to leave probation: tiles are dear to make.
#include "storage/cache/memory_cache.h"

#include <algorithm>
#include <bit>
#include <deque>
#include <mutex>
#include <unordered_map>
#include <vector>

namespace lodestone {
namespace {

constexpr std::size_t kMaxShards = 16;
constexpr std::size_t kMinShardBytes = std::size_t{8} << 20;  // a shard holds at least a few of the largest tiles
constexpr std::uint8_t kMaxUses = 3;

struct KeyHash {
  std::size_t operator()(const CacheKey& key) const { return static_cast<std::size_t>(key.lo); }
};

struct Entry {
  CacheKey key;
  CachedTilePtr tile;
  std::size_t bytes = 0;
  Entry* newer = nullptr;
  Entry* older = nullptr;
  std::uint8_t uses = 0;
  bool is_main = false;
};

// A queue of entries that live in the shard's map.
struct Fifo {
  Entry* newest = nullptr;
  Entry* oldest = nullptr;
  std::size_t bytes = 0;

  void push(Entry& entry) {
    entry.newer = nullptr;
    entry.older = newest;
    (newest ? newest->newer : oldest) = &entry;
    newest = &entry;
    bytes += entry.bytes;
  }
  void remove(Entry& entry) {
    (entry.newer ? entry.newer->older : newest) = entry.older;
    (entry.older ? entry.older->newer : oldest) = entry.newer;
    bytes -= entry.bytes;
  }
};

// The keys that left probation unused, oldest first, at most `limit` of them.
class Ghosts {
 public:
  void add(const CacheKey& key, std::size_t limit) {
    order_.emplace_back(key, ++serial_);
    serial_of_[key] = serial_;
    while (!order_.empty() && serial_of_.size() > limit) drop_oldest();
    while (order_.size() > 2 * limit + 16) drop_oldest();
  }
  bool take(const CacheKey& key) { return serial_of_.erase(key) != 0; }
  void clear() {
    order_.clear();
    serial_of_.clear();
  }

 private:
  void drop_oldest() {
    const auto& [key, serial] = order_.front();
    const auto found = serial_of_.find(key);
    if (found != serial_of_.end() && found->second == serial) serial_of_.erase(found);
    order_.pop_front();
  }

  std::deque<std::pair<CacheKey, std::uint64_t>> order_;
  std::unordered_map<CacheKey, std::uint64_t, KeyHash> serial_of_;
  std::uint64_t serial_ = 0;
};

class alignas(64) Shard {
 public:
  void set_budget(std::size_t budget_bytes) { budget_bytes_ = budget_bytes; }

  CachedTilePtr get(const CacheKey& key) {
    const std::lock_guard lock(mutex_);
    const auto found = entries_.find(key);
    if (found == entries_.end()) {
      ++misses_;
      return nullptr;
    }
    ++hits_;
    Entry& entry = found->second;
    if (entry.uses < kMaxUses) ++entry.uses;
    return entry.tile;
  }

  void put(const CacheKey& key, CachedTilePtr tile) {
    const std::size_t bytes = tile->charged_bytes();
    std::vector<CachedTilePtr> evicted;  // freed after the lock
    const std::lock_guard lock(mutex_);
    if (const auto found = entries_.find(key); found != entries_.end()) {
      Entry& old = found->second;
      queue_of(old).remove(old);
      evicted.push_back(std::move(old.tile));
      const bool was_main = old.is_main;
      const std::uint8_t uses = old.uses;
      entries_.erase(found);
      if (bytes <= budget_bytes_) insert(key, std::move(tile), bytes, was_main, uses, evicted);
      return;
    }
    if (bytes > budget_bytes_) return;
    insert(key, std::move(tile), bytes, ghosts_.take(key), 0, evicted);
  }

  void clear() {
    std::unordered_map<CacheKey, Entry, KeyHash> old;
    const std::lock_guard lock(mutex_);
    old.swap(entries_);
    small_ = main_ = Fifo{};
    ghosts_.clear();
  }

  void add_to(MemoryCache::Stats& stats) const {
    const std::lock_guard lock(mutex_);
    stats.hits += hits_;
    stats.misses += misses_;
    stats.inserts += inserts_;
    stats.evictions += evictions_;
    stats.bytes += small_.bytes + main_.bytes;
    stats.entries += entries_.size();
  }

 private:
  Fifo& queue_of(const Entry& entry) { return entry.is_main ? main_ : small_; }

  void insert(const CacheKey& key, CachedTilePtr tile, std::size_t bytes, bool is_main, std::uint8_t uses,
              std::vector<CachedTilePtr>& evicted) {
    while (small_.bytes + main_.bytes + bytes > budget_bytes_) {
      if (small_.oldest && (small_.bytes > budget_bytes_ / 10 || !main_.oldest)) {
        leave_probation(evicted);
      } else {
        turn_main(evicted);
      }
    }
    Entry& entry = entries_[key];
    entry.key = key;
    entry.tile = std::move(tile);
    entry.bytes = bytes;
    entry.uses = uses;
    entry.is_main = is_main;
    queue_of(entry).push(entry);
    ++inserts_;
  }

  void leave_probation(std::vector<CachedTilePtr>& evicted) {
    Entry& entry = *small_.oldest;
    small_.remove(entry);
    if (entry.uses > 0) {
      entry.uses = 0;
      entry.is_main = true;
      main_.push(entry);
    } else {
      ghosts_.add(entry.key, std::max<std::size_t>(entries_.size(), 64));
      drop(entry, evicted);
    }
  }

  void turn_main(std::vector<CachedTilePtr>& evicted) {
    Entry& entry = *main_.oldest;
    main_.remove(entry);
    if (entry.uses > 0) {
      --entry.uses;
      main_.push(entry);
    } else {
      drop(entry, evicted);
    }
  }

  void drop(Entry& entry, std::vector<CachedTilePtr>& evicted) {
    evicted.push_back(std::move(entry.tile));
    const CacheKey key = entry.key;
    entries_.erase(key);
    ++evictions_;
  }

  std::size_t budget_bytes_ = 0;  // constant after construction
  mutable std::mutex mutex_;      // guards all below
  std::unordered_map<CacheKey, Entry, KeyHash> entries_;
  Fifo small_, main_;
  Ghosts ghosts_;
  std::uint64_t hits_ = 0, misses_ = 0, inserts_ = 0, evictions_ = 0;
};

class ShardedMemoryCache final : public MemoryCache {
 public:
  explicit ShardedMemoryCache(std::size_t budget_bytes)
      : shards_(std::bit_floor(std::clamp<std::size_t>(budget_bytes / kMinShardBytes, 1, kMaxShards))) {
    for (Shard& shard : shards_) shard.set_budget(budget_bytes / shards_.size());
  }

  CachedTilePtr get(const CacheKey& key) override { return shard_of(key).get(key); }
  void put(const CacheKey& key, CachedTilePtr tile) override {
    if (tile) shard_of(key).put(key, std::move(tile));
  }
  void clear() override {
    for (Shard& shard : shards_) shard.clear();
  }
  Stats stats() const override {
    Stats stats;
    for (const Shard& shard : shards_) shard.add_to(stats);
    return stats;
  }

 private:
  Shard& shard_of(const CacheKey& key) { return shards_[key.hi & (shards_.size() - 1)]; }

  std::vector<Shard> shards_;
};

}  // namespace

std::unique_ptr<MemoryCache> MemoryCache::create(std::size_t budget_bytes) {
  return std::make_unique<ShardedMemoryCache>(budget_bytes);
}

}  // namespace lodestone
