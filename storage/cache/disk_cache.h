#pragma once
// DiskCache: finished tiles in LMDB, bounded in bytes, checksummed, kept over restarts. Losing an entry is allowed (a tile can
// be made again), serving a wrong byte is not. All trouble (full disk, read-only or vanished directory, bit flips) is counted
// and logged by the caller, never thrown at a request.

#include <cstdint>
#include <filesystem>
#include <functional>
#include <memory>
#include <string>

#include "kernels/types/result.h"
#include "storage/cache/memory_cache.h"

namespace lodestone {

struct DiskCacheOptions {
  std::filesystem::path directory;
  std::uint64_t budget_bytes = std::uint64_t{4} << 30;
  std::uint64_t kernel_hash = 0;  // entries of another kernel version are dropped at open
  std::size_t queue_bytes = std::size_t{32} << 20;  // writes waiting for the writer thread; more are dropped and counted
};

class DiskCache {
 public:
  struct Stats {
    std::uint64_t hits = 0, misses = 0, writes = 0, dropped_writes = 0, evictions = 0, corrupt = 0, write_errors = 0, read_errors = 0;
    std::uint64_t bytes = 0, entries = 0;
    bool is_writable = false;       // false while the disk refuses; retried every few seconds
    std::string last_error;
  };
  // Takes the directory for itself (cache.lock in it); a damaged file is thrown away and counted in `corrupt`.
  // Never fails for a bad directory, nor for one that another process has: then the cache is open but not writable, with last_error set, and keeps retrying.
  static std::unique_ptr<DiskCache> open(const DiskCacheOptions& options);
  virtual ~DiskCache() = default;  // drains the queue
  // tag: groups entries for purge_tag, e.g. "layer" or "layer/recipe".
  virtual CachedTilePtr get(const CacheKey& key) = 0;
  // Queued; group commit. Dropped and counted: more than an eighth of the budget, tags over 1000 bytes, a full queue, a refusing disk.
  virtual void put(const CacheKey& key, const std::string& tag, CachedTilePtr tile) = 0;
  virtual void flush() = 0;  // waits until everything queued before is committed (or refused)
  // Removes entries whose tag equals `tag` or starts with `tag` + "/"; empty: all. Gives the number removed.
  virtual Result<std::uint64_t> purge(const std::string& tag) = 0;
  virtual Stats stats() const = 0;
};

struct DiskCacheReport {
  std::uint64_t entries = 0, bytes = 0;
  std::uint64_t corrupt = 0;  // removed when `repair`
};
// Checks every entry. Errors: kNotFound (no cache there), kConflict (a running daemon has it open), kIo.
// A file that is no sound database at all counts as one corrupt entry; `repair` puts an empty one in its place.
Result<DiskCacheReport> verify_disk_cache(const std::filesystem::path& directory, bool repair);

}  // namespace lodestone
