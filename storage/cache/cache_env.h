#pragma once
// CacheEnv: one open LMDB environment with the cache's databases, its byte budget and its eviction (CLOCK). DiskCache adds threads, the
// queue and the retries; storage/FORMAT-CACHE.md gives the bytes.

#include <lmdb.h>

#include <cstdint>
#include <ctime>
#include <filesystem>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "kernels/types/result.h"
#include "storage/cache/lmdb_pages.h"
#include "storage/cache/memory_cache.h"
#include "storage/dem/layer_store.h"

namespace lodestone {

// What an entry takes on disk, charged against the budget: whole pages for a large value, room for its index rows.
std::uint64_t disk_charge(std::size_t body_bytes, std::size_t tag_bytes);

struct CacheWrite {
  CacheKey key;
  std::string tag;
  CachedTilePtr tile;
};

class CacheEnv {
 public:
  static constexpr std::size_t kMaxTagBytes = 1000;
  static constexpr std::uint64_t kNoBudget = std::uint64_t{1} << 62;  // evicts nothing; the map is as large as the file asks for

  struct Options {
    std::filesystem::path directory;
    std::uint64_t budget_bytes = 0;
    std::optional<std::uint64_t> kernel_hash;  // none: whatever is stored there
    bool may_create = true;                    // false: kNotFound where there is no file
    bool may_recreate = true;                  // false: kCorrupt for a damaged file
    bool may_write = true;                     // false: rows that fail their checksum stay
  };
  struct Opened {
    std::unique_ptr<CacheEnv> env;
    std::string damage;          // why the old file was thrown away; empty if it was not
    std::uint64_t bad_rows = 0;  // rows that failed their checksum; removed if may_write
  };
  // Takes the directory's lock, checks the file and throws it away when it is damaged, of another format or of another kernel version.
  // Errors: kIo, kConflict (another process has it), and those of Options.
  static Result<Opened> open(const Options& options);
  ~CacheEnv();

  // kHit: `tile` is set. kCorrupt: the entry's bytes fail their checksum. kDamaged: the file's structure breaks a rule.
  enum class Read { kHit, kMiss, kCorrupt, kDamaged, kReadError };
  // Any thread.
  Read read(const CacheKey& key, CachedTilePtr& tile) const;

  // The rest belongs to one thread.
  struct Work {
    std::span<const CacheKey> removes;    // corrupt entries
    std::span<const CacheKey> touches;    // read since the last batch
    std::span<const CacheWrite> writes;   // distinct keys
    std::uint64_t extra_bytes = 0;        // room to make beyond what the writes need
  };
  struct Done {
    int code = 0;  // 0, an LMDB code or an errno; nothing has changed unless 0
    std::uint64_t evictions = 0;
    std::uint64_t writes = 0;
  };
  Done apply(const Work& work);
  // Commits a record of no meaning, to learn whether the disk takes writes.
  Done probe();

  // Removes up to `limit` entries with that tag or below it ("tag/..."), from `from` on; sets `from` to where to go on, empty at the end.
  Done purge_some(const std::string& tag, std::string& from, std::size_t limit, std::uint64_t& removed);

  // Walks the whole structure and counts bytes and entries anew. Gives the rows that fail their checksum.
  PageStatus check(std::string& reason, std::vector<CacheKey>& bad_rows);

  // True while the directory still holds the file that is open, and the file has not shrunk.
  bool is_in_place(std::string& reason) const;
  // True when somebody else has written to the file since our last commit (as far as the clock of file times can tell).
  bool is_foreign() const;

  // All keys, in order.
  PageStatus keys(std::vector<CacheKey>& out) const;

  std::uint64_t bytes() const { return bytes_; }
  std::uint64_t entries() const { return entries_; }

  // Deletes the cache's files.
  static void erase_files(const std::filesystem::path& directory);

 private:
  explicit CacheEnv(FileLock lock) : lock_(std::move(lock)) {}
  static Result<Opened> open_locked(const Options& options, FileLock lock);
  bool is_current(const Options& options) const;
  Result<void> open_lmdb(const Options& options);
  Result<void> shrink(const Options& options);
  int remove_entry(MDB_txn* txn, const LmdbSnapshot& snapshot, const CacheKey& key);
  int mend(const LmdbSnapshot& snapshot, const CacheKey& key) const;
  int touch(MDB_txn* txn, const CacheKey& key);
  int evict(MDB_txn* txn, const LmdbSnapshot& snapshot, std::uint64_t allowed_bytes, std::uint64_t& evictions);
  int write(MDB_txn* txn, const CacheWrite& write);
  bool is_stored(const LmdbSnapshot& snapshot, const CacheWrite& write) const;
  int commit(MDB_txn* txn, int code);
  void note_file();
  Done apply_checked(const Work& work);
  Done purge_checked(const std::string& tag, std::string& from, std::size_t limit, std::uint64_t& removed);
  template <class Task>
  Done guarded(const Task& task);

  FileLock lock_;
  std::filesystem::path directory_;
  std::uint64_t budget_bytes_ = 0;
  MDB_env* env_ = nullptr;
  MDB_dbi blobs_ = 0, rows_ = 0, settings_ = 0;
  int fd_ = -1;  // our own, for LmdbPages
  LmdbPages pages_;
  std::string hand_;               // of the clock: the next key to look at
  std::uint64_t bytes_ = 0, entries_ = 0;
  std::uint64_t file_bytes_ = 0;   // after the last commit
  timespec file_time_{};
  bool is_abandoned_ = false;      // LMDB gave up within a transaction: never closed, see apply()
};

// For messages: LMDB's codes and errno.
std::string lmdb_text(int code);

}  // namespace lodestone
