#include "storage/cache/disk_cache.h"

#include <sys/statvfs.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <deque>
#include <future>
#include <mutex>
#include <shared_mutex>
#include <thread>
#include <unordered_map>
#include <unordered_set>

#include "storage/cache/cache_env.h"

namespace lodestone {
namespace {

using Clock = std::chrono::steady_clock;
using namespace std::chrono_literals;

constexpr std::size_t kBatchEntries = 32;
constexpr std::uint64_t kMaxBatchBytes = std::uint64_t{8} << 20;
constexpr auto kBatchWait = 50ms;     // an entry waits no longer for company
constexpr auto kTick = 500ms;         // the writer looks around this often when idle
constexpr auto kRetryWait = 2s;       // between tries while the disk refuses
constexpr auto kTouchWait = 5s;       // uses are written this often without other writes
constexpr auto kCheckWait = 1s;       // least time between walks over the structure when idle
constexpr std::size_t kMaxTouches = 8192;
constexpr std::size_t kPurgeStep = 500;  // entries per transaction

struct KeyHash {
  std::size_t operator()(const CacheKey& key) const { return static_cast<std::size_t>(key.lo ^ key.hi); }
};
using KeySet = std::unordered_set<CacheKey, KeyHash>;

bool is_damage(int code) { return code == MDB_CORRUPTED || code == MDB_PAGE_NOTFOUND || code == MDB_INVALID; }

class LmdbDiskCache final : public DiskCache {
 public:
  explicit LmdbDiskCache(const DiskCacheOptions& options)
      : options_(options), max_entry_bytes_(options.budget_bytes / 8), batch_bytes_(std::clamp<std::uint64_t>(options.budget_bytes / 16, 65536, kMaxBatchBytes)) {
    if (options_.budget_bytes == 0) {
      set_error("the budget is 0: the disk cache is off");
      return;
    }
    try_open();
    writer_ = std::thread([this] { run(); });
  }

  ~LmdbDiskCache() override {
    {
      const std::lock_guard lock(mutex_);
      is_stopping_ = true;
    }
    wake_.notify_all();
    if (writer_.joinable()) writer_.join();
  }

  CachedTilePtr get(const CacheKey& key) override {
    CachedTilePtr tile;
    auto outcome = CacheEnv::Read::kMiss;
    {
      const std::shared_lock lock(env_mutex_);
      if (env_) outcome = env_->read(key, tile);
    }
    if (outcome == CacheEnv::Read::kHit) {
      ++hits_;
      const std::lock_guard lock(touch_mutex_);
      if (touches_.size() < kMaxTouches) touches_.insert(key);
      return tile;
    }
    ++misses_;
    if (outcome == CacheEnv::Read::kReadError) ++read_errors_;
    if (outcome == CacheEnv::Read::kCorrupt) {
      {
        const std::lock_guard lock(mutex_);
        if (!removes_.insert(key).second) return nullptr;
        ++removes_queued_;
      }
      ++corrupt_;
      wake_.notify_all();
    }
    if (outcome == CacheEnv::Read::kDamaged) {
      {
        const std::lock_guard lock(mutex_);
        is_suspect_ = true;
      }
      wake_.notify_all();
    }
    return nullptr;
  }

  void put(const CacheKey& key, const std::string& tag, CachedTilePtr tile) override {
    if (!tile) return;
    const std::uint64_t charge = disk_charge(tile->body.size(), tag.size());
    const std::lock_guard lock(mutex_);
    const bool is_refused = options_.budget_bytes == 0 || is_stopping_ || (!is_writable_ && Clock::now() < retry_at_);
    if (is_refused || charge > max_entry_bytes_ || tag.size() > CacheEnv::kMaxTagBytes || queued_bytes_ + charge > options_.queue_bytes) {
      ++dropped_writes_;
      return;
    }
    if (queue_.empty()) oldest_queued_at_ = Clock::now();
    queue_.push_back({key, tag, std::move(tile)});
    queued_bytes_ += charge;
    ++puts_queued_;
    // The writer sleeps until the oldest entry has waited long enough; wake it for the first and for a full batch.
    if (queue_.size() == 1 || queue_.size() == kBatchEntries || queued_bytes_ >= batch_bytes_) wake_.notify_all();
  }

  void flush() override {
    std::unique_lock lock(mutex_);
    if (!writer_.joinable()) return;
    const std::uint64_t puts = puts_queued_, removes = removes_queued_;
    flush_target_ = std::max(flush_target_, puts);
    wake_.notify_all();
    done_.wait(lock, [&] { return puts_done_ >= puts && removes_done_ >= removes; });
  }

  Result<std::uint64_t> purge(const std::string& tag) override {
    if (!writer_.joinable()) return std::uint64_t{0};
    Purge purge;
    purge.tag = tag;
    std::future<Result<std::uint64_t>> answer = purge.answer.get_future();
    {
      const std::lock_guard lock(mutex_);
      purge.after_puts = puts_queued_;
      flush_target_ = std::max(flush_target_, puts_queued_);
      purges_.push_back(std::move(purge));
    }
    wake_.notify_all();
    return answer.get();
  }

  Stats stats() const override {
    Stats stats;
    stats.hits = hits_;
    stats.misses = misses_;
    stats.writes = writes_;
    stats.dropped_writes = dropped_writes_;
    stats.evictions = evictions_;
    stats.corrupt = corrupt_;
    stats.write_errors = write_errors_;
    stats.read_errors = read_errors_;
    stats.bytes = bytes_;
    stats.entries = entries_;
    stats.is_writable = is_writable_;
    const std::lock_guard lock(error_mutex_);
    stats.last_error = last_error_;
    return stats;
  }

 private:
  struct Purge {
    std::string tag;
    std::uint64_t after_puts = 0;
    std::promise<Result<std::uint64_t>> answer;
  };

  void set_error(std::string text) {
    const std::lock_guard lock(error_mutex_);
    last_error_ = std::move(text);
  }

  // The writer's turn: everything below up to the members runs on its thread (or in the constructor).

  void run() {
    std::unique_lock lock(mutex_);
    while (true) {
      wake_.wait_until(lock, next_wake(), [&] { return is_due(); });
      const bool is_last = is_stopping_;
      const bool may_write = is_writable_ || is_stopping_ || Clock::now() >= retry_at_;
      std::deque<CacheWrite> writes = is_batch_due() ? take_batch() : std::deque<CacheWrite>{};
      const std::vector<CacheKey> removes(removes_.begin(), removes_.end());
      const std::uint64_t removes_goal = removes_queued_;
      const bool is_suspect = std::exchange(is_suspect_, false);
      lock.unlock();

      const std::size_t taken = writes.size();
      look_around(is_suspect, may_write, taken > 0 || !removes.empty());
      if (!writes.empty() || !removes.empty() || touches_due()) write_batch(std::move(writes), removes, may_write);

      lock.lock();
      for (const CacheKey& key : removes) removes_.erase(key);
      puts_done_ += taken;
      removes_done_ = std::max(removes_done_, removes_goal);
      run_purges(lock);
      done_.notify_all();
      if (is_last && queue_.empty() && purges_.empty()) return;
    }
  }

  Clock::time_point next_wake() const {
    const Clock::time_point tick = Clock::now() + kTick;
    return queue_.empty() ? tick : std::min(tick, oldest_queued_at_ + kBatchWait);
  }

  bool is_batch_due() const {
    return !queue_.empty() && (queue_.size() >= kBatchEntries || queued_bytes_ >= batch_bytes_ || is_stopping_ || flush_target_ > puts_done_ ||
                               Clock::now() >= oldest_queued_at_ + kBatchWait);
  }
  bool is_due() const { return is_stopping_ || is_batch_due() || !removes_.empty() || !purges_.empty() || is_suspect_; }

  std::deque<CacheWrite> take_batch() {
    std::deque<CacheWrite> batch;
    std::uint64_t bytes = 0;
    while (!queue_.empty() && batch.size() < kBatchEntries) {
      const std::uint64_t charge = disk_charge(queue_.front().tile->body.size(), queue_.front().tag.size());
      if (!batch.empty() && bytes + charge > batch_bytes_) break;
      bytes += charge;
      batch.push_back(std::move(queue_.front()));
      queue_.pop_front();
    }
    queued_bytes_ -= bytes;
    oldest_queued_at_ = Clock::now();
    return batch;
  }

  void run_purges(std::unique_lock<std::mutex>& lock) {
    while (!purges_.empty() && purges_.front().after_puts <= puts_done_) {
      Purge purge = std::move(purges_.front());
      purges_.pop_front();
      lock.unlock();
      purge.answer.set_value(do_purge(purge.tag));
      lock.lock();
    }
  }

  // Opens the environment; on failure the disk counts as refusing.
  bool try_open() {
    CacheEnv::Options options{options_.directory, options_.budget_bytes, options_.kernel_hash};
    Result<CacheEnv::Opened> opened = CacheEnv::open(options);
    if (!opened) {
      refuse(opened.error().message);
      return false;
    }
    corrupt_ += opened->bad_rows + (opened->damage.empty() ? 0 : 1);
    if (!opened->damage.empty()) {
      set_error(opened->damage + "; the cache starts empty");
    }
    const std::unique_lock lock(env_mutex_);
    env_ = std::move(opened->env);
    publish();
    is_writable_ = true;
    next_check_ = Clock::now() + kCheckWait;
    return true;
  }

  // Closes the environment; `is_erased`: throws its files away, too.
  void close_env(bool is_erased) {
    const std::unique_lock lock(env_mutex_);
    if (!env_) return;
    if (is_erased) CacheEnv::erase_files(options_.directory);
    env_.reset();
    bytes_ = entries_ = 0;
  }

  void refuse(std::string text) {
    set_error(std::move(text));
    const std::lock_guard lock(mutex_);
    is_writable_ = false;
    retry_at_ = Clock::now() + kRetryWait;
  }

  void publish() {
    bytes_ = env_->bytes();
    entries_ = env_->entries();
  }

  // Is our file still there, still whole? Is it time to try a refusing disk again?
  void look_around(bool is_suspect, bool may_write, bool has_work) {
    if (env_) {
      std::string reason;
      if (!env_->is_in_place(reason)) {
        corrupt_ += reason.ends_with("short") ? std::max<std::uint64_t>(1, entries_) : 0;
        close_env(reason.ends_with("short"));
        set_error(reason + "; the cache starts again");
        try_open();
        return;
      }
      if (is_suspect || Clock::now() >= (has_work ? next_busy_check_ : next_check_) || env_->is_foreign()) check_structure();
      if (env_ && !is_writable_ && may_write && is_room()) probe();
      return;
    }
    if (may_write) try_open();
  }

  void check_structure() {
    const Clock::time_point start = Clock::now();
    std::string reason;
    std::vector<CacheKey> bad_rows;
    const PageStatus status = env_->check(reason, bad_rows);
    if (status == PageStatus::kReadError) {
      ++read_errors_;
      set_error("disk cache " + options_.directory.string() + ": reading its structure failed");
    } else if (status == PageStatus::kDamaged) {
      start_anew(reason);
    } else if (!bad_rows.empty()) {
      const std::lock_guard lock(mutex_);
      for (const CacheKey& key : bad_rows) {
        if (!removes_.insert(key).second) continue;
        ++removes_queued_;
        ++corrupt_;
      }
    }
    // At most a fifth of the time goes into this while there is something to write, else a fiftieth.
    const Clock::time_point end = Clock::now();
    next_busy_check_ = end + 4 * (end - start);
    next_check_ = end + std::max<Clock::duration>(kCheckWait, 50 * (end - start));
  }

  void start_anew(const std::string& reason) {
    corrupt_ += std::max<std::uint64_t>(1, entries_);
    close_env(true);
    set_error("disk cache " + options_.directory.string() + " was damaged (" + reason + ") and starts empty");
    try_open();
  }

  bool is_room() const {
    struct statvfs info {};
    if (::statvfs(options_.directory.c_str(), &info) != 0) return false;
    return std::uint64_t{info.f_bavail} * info.f_frsize >= std::min<std::uint64_t>(refused_bytes_ + 65536, options_.budget_bytes / 4);
  }

  // A commit that changes next to nothing: does the disk take it again?
  void probe() {
    const CacheEnv::Done done = env_->probe();
    if (done.code == 0) {
      is_writable_ = true;
    } else {
      failed(done.code, 0);
    }
  }

  bool touches_due() {
    const std::lock_guard lock(touch_mutex_);
    return !touches_.empty() && (touches_.size() >= kMaxTouches / 2 || Clock::now() >= next_touches_);
  }

  void write_batch(std::deque<CacheWrite> queued, const std::vector<CacheKey>& removes, bool may_write) {
    // The last write of a key wins.
    std::vector<CacheWrite> writes;
    std::unordered_map<CacheKey, std::size_t, KeyHash> place;
    for (CacheWrite& write : queued) {
      const auto [found, is_new] = place.try_emplace(write.key, writes.size());
      if (is_new) {
        writes.push_back(std::move(write));
      } else {
        writes[found->second] = std::move(write);
      }
    }
    if (!env_ || !may_write) {
      dropped_writes_ += writes.size();
      return;
    }
    KeySet touched;
    {
      const std::lock_guard lock(touch_mutex_);
      touched.swap(touches_);
      next_touches_ = Clock::now() + kTouchWait;
    }
    const std::vector<CacheKey> touches(touched.begin(), touched.end());
    std::uint64_t batch_bytes = 0;
    for (const CacheWrite& write : writes) batch_bytes += disk_charge(write.tile->body.size(), write.tag.size());

    CacheEnv::Work work{removes, touches, writes};
    CacheEnv::Done done = env_->apply(work);
    // The map is full although the budget is not: free pages lie scattered, or a reader that sleeps in the middle of its work keeps
    // the pages of all commits since. Wait for the readers, keep new ones out meanwhile, and make more room each time.
    for (int attempt = 1; done.code == MDB_MAP_FULL && attempt <= 4; ++attempt) {
      const std::unique_lock no_readers(env_mutex_);
      CacheEnv::Work room;
      room.extra_bytes = std::min(options_.budget_bytes, batch_bytes + options_.budget_bytes / 16 * attempt);
      const CacheEnv::Done made = env_->apply(room);
      if (made.code != 0) break;
      evictions_ += made.evictions;
      work.touches = {};
      done = env_->apply(work);
    }
    if (done.code == MDB_MAP_FULL) {
      evictions_ += entries_;
      close_env(true);
      set_error("disk cache " + options_.directory.string() + ": no room in the map even after evictions; it starts empty");
      if (try_open()) done = env_->apply(work);
    }
    if (is_damage(done.code)) {
      ++write_errors_;
      start_anew(lmdb_text(done.code));
      if (env_) done = env_->apply({.writes = writes});
    }
    if (env_ && done.code == 0) {
      if (!writes.empty()) is_writable_ = true;
      writes_ += writes.size();
      evictions_ += done.evictions;
      publish();
    } else {
      dropped_writes_ += writes.size();
      if (env_) failed(done.code, batch_bytes);
    }
  }

  void failed(int code, std::uint64_t batch_bytes) {
    ++write_errors_;
    refused_bytes_ = batch_bytes;
    if (is_damage(code)) return start_anew(lmdb_text(code));
    refuse("disk cache " + options_.directory.string() + ": writing failed: " + lmdb_text(code));
    if (code == MDB_PANIC) close_env(false);
  }

  Result<std::uint64_t> do_purge(const std::string& tag) {
    if (!env_) return Error{ErrorCode::kIo, "the disk cache cannot be purged: " + stats().last_error};
    std::uint64_t removed = 0;
    if (tag.empty()) {  // a new file is faster, and gives the room back
      removed = entries_;
      close_env(true);
      if (!try_open()) return Error{ErrorCode::kIo, "the purged disk cache cannot be opened again: " + stats().last_error};
      return removed;
    }
    std::string from;
    do {
      const CacheEnv::Done done = env_->purge_some(tag, from, kPurgeStep, removed);
      if (done.code != 0) {
        failed(done.code, 0);
        return Error{ErrorCode::kIo, "purging the disk cache stopped after " + std::to_string(removed) + " entries: " + lmdb_text(done.code)};
      }
    } while (!from.empty());
    publish();
    return removed;
  }

  const DiskCacheOptions options_;          // constant after construction
  const std::uint64_t max_entry_bytes_;
  const std::uint64_t batch_bytes_;

  mutable std::shared_mutex env_mutex_;     // readers of the environment share it; the writer takes it whole to replace env_
  std::unique_ptr<CacheEnv> env_;           // replaced by the writer only, which therefore reads it without the lock

  std::mutex mutex_;                        // guards all up to the next group
  std::condition_variable wake_, done_;
  std::deque<CacheWrite> queue_;
  std::uint64_t queued_bytes_ = 0;
  std::uint64_t puts_queued_ = 0, puts_done_ = 0, flush_target_ = 0;
  std::uint64_t removes_queued_ = 0, removes_done_ = 0;
  KeySet removes_;                          // corrupt entries, until the writer has deleted them
  std::deque<Purge> purges_;
  Clock::time_point oldest_queued_at_, retry_at_;
  bool is_suspect_ = false;                 // a reader met a broken structure
  bool is_stopping_ = false;

  std::mutex touch_mutex_;                  // guards touches_ and next_touches_
  KeySet touches_;
  Clock::time_point next_touches_ = Clock::now() + kTouchWait;

  mutable std::mutex error_mutex_;          // guards last_error_
  std::string last_error_;

  Clock::time_point next_check_, next_busy_check_;  // the writer's own
  std::uint64_t refused_bytes_ = 0;

  std::atomic<bool> is_writable_ = false;
  std::atomic<std::uint64_t> hits_ = 0, misses_ = 0, writes_ = 0, dropped_writes_ = 0, evictions_ = 0, corrupt_ = 0, write_errors_ = 0,
                             read_errors_ = 0, bytes_ = 0, entries_ = 0;
  std::thread writer_;                      // last: it uses all the others
};

}  // namespace

std::unique_ptr<DiskCache> DiskCache::open(const DiskCacheOptions& options) { return std::make_unique<LmdbDiskCache>(options); }

Result<DiskCacheReport> verify_disk_cache(const std::filesystem::path& directory, bool repair) {
  CacheEnv::Options options;
  options.directory = directory;
  options.budget_bytes = CacheEnv::kNoBudget;  // looks only: nothing is evicted
  options.may_create = false;
  options.may_recreate = repair;
  options.may_write = repair;
  DiskCacheReport report;
  Result<CacheEnv::Opened> opened = CacheEnv::open(options);
  if (!opened && opened.error().code == ErrorCode::kCorrupt) {
    report.corrupt = 1;
    return report;
  }
  if (!opened) return std::move(opened.error());
  CacheEnv& env = *opened->env;
  report.corrupt = (opened->damage.empty() ? 0 : 1) + opened->bad_rows;
  std::vector<CacheKey> keys, corrupt;
  if (env.keys(keys) == PageStatus::kReadError) return Error{ErrorCode::kIo, "disk cache " + directory.string() + ": reading failed"};
  for (const CacheKey& key : keys) {
    CachedTilePtr tile;
    const CacheEnv::Read outcome = env.read(key, tile);
    if (outcome == CacheEnv::Read::kReadError) return Error{ErrorCode::kIo, "disk cache " + directory.string() + ": reading failed"};
    if (outcome == CacheEnv::Read::kHit) continue;
    corrupt.push_back(key);
  }
  report.corrupt += corrupt.size();
  if (repair && !corrupt.empty()) {
    if (const CacheEnv::Done done = env.apply({.removes = corrupt}); done.code != 0) {
      return Error{ErrorCode::kIo, "disk cache " + directory.string() + ": removing corrupt entries failed: " + lmdb_text(done.code)};
    }
  }
  report.entries = env.entries() - (repair ? 0 : std::min<std::uint64_t>(corrupt.size(), env.entries()));
  report.bytes = env.bytes();
  return report;
}

}  // namespace lodestone
