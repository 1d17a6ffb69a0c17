#include "storage/cache/cache_env.h"

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>
#include <xxhash.h>

#include <algorithm>
#include <cerrno>
#include <cstring>

#include "storage/cache/cache_entry.h"

namespace lodestone {
namespace {

constexpr const char* kDataFile = "data.mdb";
constexpr const char* kLmdbLockFile = "lock.mdb";
constexpr const char* kOwnerLockFile = "cache.lock";
constexpr std::size_t kLockFileBytes = 65536;  // room for 1000 readers at a time
constexpr std::uint64_t kSpareMapBytes = std::uint64_t{1} << 20;  // small caches need more than a quarter for the copies of a commit
constexpr std::size_t kMaxInlineBytes = 1950;  // larger values get pages of their own (LMDB, 4096-byte pages)
constexpr char kFormatKey[] = "format";        // in "settings": version, then kernel hash
constexpr std::uint32_t kFormatVersion = 1;    // on disk: any change drops the caches of old versions

struct Settings {
  std::uint32_t version = kFormatVersion;
  std::uint32_t zero = 0;
  std::uint64_t kernel_hash = 0;
};

MDB_val val(std::string_view bytes) { return {bytes.size(), const_cast<char*>(bytes.data())}; }
std::string_view view(const MDB_val& value) { return {static_cast<const char*>(value.mv_data), value.mv_size}; }

std::uint64_t map_bytes(std::uint64_t budget_bytes) {
  return (budget_bytes + budget_bytes / 4 + kSpareMapBytes) / 65536 * 65536;
}

// LMDB met a page that contradicts itself. It would abort the process; its assert hook may not return, so it throws.
struct LmdbAssertion {};
[[noreturn]] void throw_assertion(MDB_env*, const char*) { throw LmdbAssertion{}; }

Error io_error(const std::filesystem::path& path, const std::string& task, int code) {
  return Error{ErrorCode::kIo, "disk cache " + path.string() + ": " + task + " failed: " + lmdb_text(code)};
}

}  // namespace

std::string lmdb_text(int code) { return code < 0 ? mdb_strerror(code) : std::strerror(code); }

std::uint64_t disk_charge(std::size_t body_bytes, std::size_t tag_bytes) {
  const std::uint64_t value_bytes = kValueHeadBytes + body_bytes;
  const std::uint64_t row_bytes = kRowHeadBytes + tag_bytes + kKeyBytes + 10;
  const bool is_inline = value_bytes <= kMaxInlineBytes;
  const std::uint64_t index_bytes = row_bytes + kKeyBytes + 10 + (is_inline ? value_bytes : 8);
  const std::uint64_t page_bytes = is_inline ? 0 : (LmdbPages::kHeaderBytes + value_bytes + 4095) / 4096 * 4096;
  return page_bytes + index_bytes + index_bytes / 2;  // B-tree pages are two thirds full
}

void CacheEnv::erase_files(const std::filesystem::path& directory) {
  std::error_code ignored;
  for (const char* name : {kDataFile, kLmdbLockFile, "compact.tmp"}) std::filesystem::remove_all(directory / name, ignored);
}

Result<CacheEnv::Opened> CacheEnv::open(const Options& options) {
  std::error_code failure;
  if (!options.may_create && !std::filesystem::exists(options.directory / kDataFile, failure)) {
    return Error{ErrorCode::kNotFound, "no disk cache in " + options.directory.string() + ": " + kDataFile + " is missing"};
  }
  std::filesystem::create_directories(options.directory, failure);
  if (failure) return io_error(options.directory, "creating the directory", failure.value());
  Result<FileLock> lock = FileLock::acquire(options.directory / kOwnerLockFile, "disk cache " + options.directory.string());
  if (!lock) return std::move(lock.error());
  return open_locked(options, std::move(*lock));
}

Result<CacheEnv::Opened> CacheEnv::open_locked(const Options& options, FileLock lock) {
  Opened opened;
  opened.env.reset(new CacheEnv(std::move(lock)));
  CacheEnv& env = *opened.env;
  env.directory_ = options.directory;
  env.budget_bytes_ = options.budget_bytes;
  const std::filesystem::path data = options.directory / kDataFile;

  // What is there: nothing, a sound file of ours, or something to throw away.
  std::vector<CacheKey> bad_rows;
  bool is_stale = false;
  env.fd_ = ::open(data.c_str(), O_RDWR | O_CLOEXEC);
  if (env.fd_ < 0 && errno != ENOENT) return io_error(data, "opening", errno);
  if (env.fd_ >= 0) {
    env.pages_ = LmdbPages(env.fd_, static_cast<std::size_t>(::sysconf(_SC_PAGESIZE)));
    struct stat info {};
    const bool is_fresh = ::fstat(env.fd_, &info) == 0 && info.st_size == 0;
    std::string reason = "a meta page";
    const PageStatus status = is_fresh ? PageStatus::kOk : env.check(reason, bad_rows);
    if (status == PageStatus::kReadError) return io_error(data, "reading", errno);
    if (status == PageStatus::kDamaged || status == PageStatus::kAbsent) {
      opened.damage = data.string() + " is damaged (" + reason + ")";
      if (!options.may_recreate) return Error{ErrorCode::kCorrupt, opened.damage + "; verify with repair, or delete the directory"};
    } else if (!is_fresh) {
      is_stale = !env.is_current(options);
    }
    if (is_stale && !options.may_recreate) {
      return Error{ErrorCode::kCorrupt, data.string() + " is of another format version; verify with repair, or delete the directory"};
    }
    if (!opened.damage.empty() || is_stale) {
      ::close(std::exchange(env.fd_, -1));
      erase_files(options.directory);
      env.bytes_ = env.entries_ = 0;
      bad_rows.clear();
    }
  }
  if (Result<void> result = env.open_lmdb(options); !result) return std::move(result.error());
  struct stat info {};
  if (::fstat(env.fd_, &info) == 0 && static_cast<std::uint64_t>(info.st_size) > map_bytes(options.budget_bytes)) {
    if (Result<void> result = env.shrink(options); !result) return std::move(result.error());
  }
  opened.bad_rows = bad_rows.size();
  if (!bad_rows.empty() && options.may_write) {
    if (const Done done = env.apply({.removes = bad_rows}); done.code != 0) return io_error(data, "removing damaged rows", done.code);
  }
  return opened;
}

// Is the file of our format and of the wanted kernel version?
bool CacheEnv::is_current(const Options& options) const {
  LmdbSnapshot snapshot;
  LmdbTree tree;
  LmdbNode node;
  char page[LmdbPages::kMaxPageBytes];
  if (pages_.newest(snapshot) != PageStatus::kOk || pages_.named_tree(snapshot, "settings", tree) != PageStatus::kOk ||
      pages_.find(snapshot, tree, kFormatKey, page, node) != PageStatus::kOk || node.value.size() != sizeof(Settings)) {
    return false;
  }
  Settings found;
  std::memcpy(&found, node.value.data(), sizeof found);
  return found.version == kFormatVersion && (!options.kernel_hash || found.kernel_hash == *options.kernel_hash);
}

Result<void> CacheEnv::open_lmdb(const Options& options) {
  const std::filesystem::path lock_path = directory_ / kLmdbLockFile;
  // We hold the directory, so LMDB's lock file may be new each time. It is mapped: its room must be there, or a full disk is a SIGBUS.
  ::unlink(lock_path.c_str());
  const int lock_fd = ::open(lock_path.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, 0644);
  if (lock_fd < 0) return io_error(lock_path, "creating", errno);
  const int allocated = ::posix_fallocate(lock_fd, 0, kLockFileBytes);
  ::close(lock_fd);
  if (allocated != 0) return io_error(lock_path, "allocating", allocated);

  int code = mdb_env_create(&env_);
  if (code == 0) code = mdb_env_set_maxdbs(env_, 4);
  if (code == 0) code = mdb_env_set_maxreaders(env_, 500);
  if (code == 0) code = mdb_env_set_assert(env_, throw_assertion);
  std::error_code failure;
  const std::uint64_t old_bytes = fd_ < 0 ? 0 : std::filesystem::file_size(directory_ / kDataFile, failure);
  // A file that is too large for the budget still needs room to delete from; shrink() follows.
  const std::uint64_t wanted_bytes = options.budget_bytes == kNoBudget ? 0 : map_bytes(options.budget_bytes);
  const bool is_too_large = !failure && old_bytes > wanted_bytes;
  if (code == 0) code = mdb_env_set_mapsize(env_, is_too_large ? map_bytes(old_bytes) : wanted_bytes);
  if (code == 0) code = mdb_env_open(env_, directory_.c_str(), MDB_NOSYNC | MDB_NOTLS | MDB_NORDAHEAD, 0644);
  if (code != 0) return io_error(directory_ / kDataFile, "opening", code);

  MDB_txn* txn = nullptr;
  code = mdb_txn_begin(env_, nullptr, 0, &txn);
  if (code != 0) return io_error(directory_, "the first transaction", code);
  code = mdb_dbi_open(txn, "blobs", MDB_CREATE, &blobs_);
  if (code == 0) code = mdb_dbi_open(txn, "rows", MDB_CREATE, &rows_);
  if (code == 0) code = mdb_dbi_open(txn, "settings", MDB_CREATE, &settings_);
  MDB_val key = val(kFormatKey), old{};
  if (code == 0 && mdb_get(txn, settings_, &key, &old) == MDB_NOTFOUND) {
    Settings wanted;
    wanted.kernel_hash = options.kernel_hash.value_or(0);
    MDB_val value{sizeof wanted, &wanted};
    code = mdb_put(txn, settings_, &key, &value, 0);
  }
  code = commit(txn, code);
  if (code != 0) return io_error(directory_ / kDataFile, "creating the databases", code);
  if (fd_ < 0) fd_ = ::open((directory_ / kDataFile).c_str(), O_RDWR | O_CLOEXEC);
  if (fd_ < 0) return io_error(directory_ / kDataFile, "opening", errno);
  pages_ = LmdbPages(fd_, static_cast<std::size_t>(::sysconf(_SC_PAGESIZE)));
  note_file();
  return {};
}

// The file is larger than a smaller budget allows: evict, then put a compacted copy in its place. LMDB never shrinks a file itself.
Result<void> CacheEnv::shrink(const Options& options) {
  Done done = apply({});
  while (done.code == 0 && done.evictions > 0) done = apply({});
  const std::filesystem::path copy = directory_ / "compact.tmp";
  std::error_code failure;
  std::filesystem::remove_all(copy, failure);
  std::filesystem::create_directories(copy, failure);
  int code = done.code != 0 ? done.code : failure.value();
  if (code == 0) code = mdb_env_copy2(env_, copy.c_str(), MDB_CP_COMPACT);
  if (!std::exchange(is_abandoned_, false)) mdb_env_close(env_);
  env_ = nullptr;
  ::close(std::exchange(fd_, -1));
  const bool is_small = code == 0 && std::filesystem::file_size(copy / kDataFile, failure) <= map_bytes(options.budget_bytes) && !failure;
  if (is_small) std::filesystem::rename(copy / kDataFile, directory_ / kDataFile, failure);
  if (!is_small || failure) {
    erase_files(directory_);
    bytes_ = entries_ = 0;
  }
  std::filesystem::remove_all(copy, failure);
  return open_lmdb(options);
}

CacheEnv::~CacheEnv() {
  if (env_ && !is_abandoned_) mdb_env_close(env_);
  if (fd_ >= 0) ::close(fd_);
}

CacheEnv::Read CacheEnv::read(const CacheKey& key, CachedTilePtr& tile) const {
  MDB_txn* txn = nullptr;
  if (mdb_txn_begin(env_, nullptr, MDB_RDONLY, &txn) != 0) return Read::kReadError;
  const std::unique_ptr<MDB_txn, decltype(&mdb_txn_abort)> pin(txn, &mdb_txn_abort);  // keeps the snapshot's pages from reuse
  const auto read_of = [](PageStatus status) {
    return status == PageStatus::kAbsent ? Read::kMiss : status == PageStatus::kDamaged ? Read::kDamaged : Read::kReadError;
  };

  LmdbSnapshot snapshot;
  PageStatus status = PageStatus::kAbsent;
  for (int attempt = 0; attempt < 16 && status == PageStatus::kAbsent; ++attempt) {
    status = pages_.numbered(mdb_txn_id(txn), snapshot);
    if (status == PageStatus::kAbsent) {  // two commits since: the state's meta page has been overwritten
      mdb_txn_reset(txn);
      if (mdb_txn_renew(txn) != 0) return Read::kReadError;
    }
  }
  if (status != PageStatus::kOk) return read_of(status);
  LmdbTree tree;
  status = pages_.named_tree(snapshot, "blobs", tree);
  const std::string name = bytes_of_key(key);
  char page[LmdbPages::kMaxPageBytes];
  LmdbNode node;
  if (status == PageStatus::kOk) status = pages_.find(snapshot, tree, name, page, node);
  if (status != PageStatus::kOk) return read_of(status);
  if (node.size < kValueHeadBytes || node.size > snapshot.last_page * pages_.page_bytes()) return Read::kDamaged;

  auto found = std::make_shared<CachedTile>();
  char head[kValueHeadBytes];
  if (node.is_large) {
    found->body.resize(node.size - kValueHeadBytes);
    status = pages_.read_large(node, head, sizeof head, found->body.data(), found->body.size());
    if (status == PageStatus::kReadError) return Read::kReadError;
    if (status == PageStatus::kDamaged) return Read::kCorrupt;
  } else {
    std::memcpy(head, node.value.data(), sizeof head);
    found->body.assign(node.value.substr(kValueHeadBytes));
  }
  if (!read_value_head(name, head, *found)) return Read::kCorrupt;
  tile = std::move(found);
  return Read::kHit;
}

int CacheEnv::commit(MDB_txn* txn, int code) {
  if (code != 0) {
    mdb_txn_abort(txn);
    return code;
  }
  code = mdb_txn_commit(txn);
  note_file();
  return code;
}

void CacheEnv::note_file() {
  struct stat info {};
  if (fd_ < 0 || ::fstat(fd_, &info) != 0) return;
  file_bytes_ = static_cast<std::uint64_t>(info.st_size);
  file_time_ = info.st_mtim;
}

// Runs a task that writes. When a bit flips between the last check and now, LMDB may give up within the transaction; then the
// environment is left as it is (its lock is held, its pages are in between) and the caller starts anew with other files.
template <class Task>
CacheEnv::Done CacheEnv::guarded(const Task& task) {
  const std::uint64_t old_bytes = bytes_, old_entries = entries_;
  Done done;
  try {
    done = task();
  } catch (const LmdbAssertion&) {
    is_abandoned_ = true;
    done = {MDB_CORRUPTED, 0, 0};
  }
  if (done.code != 0) {
    bytes_ = old_bytes;
    entries_ = old_entries;
    done.evictions = 0;
  }
  return done;
}

CacheEnv::Done CacheEnv::apply(const Work& work) {
  return guarded([&] { return apply_checked(work); });
}

CacheEnv::Done CacheEnv::purge_some(const std::string& tag, std::string& from, std::size_t limit, std::uint64_t& removed) {
  return guarded([&] { return purge_checked(tag, from, limit, removed); });
}

CacheEnv::Done CacheEnv::probe() {
  return guarded([&] {
    Done done;
    MDB_txn* txn = nullptr;
    done.code = mdb_txn_begin(env_, nullptr, 0, &txn);
    if (done.code != 0) return done;
    const std::uint64_t number = mdb_txn_id(txn);
    MDB_val key = val("probe"), value{sizeof number, const_cast<std::uint64_t*>(&number)};
    done.code = commit(txn, mdb_put(txn, settings_, &key, &value, 0));
    return done;
  });
}

CacheEnv::Done CacheEnv::apply_checked(const Work& work) {
  Done done;
  LmdbSnapshot snapshot;
  if (const PageStatus status = pages_.newest(snapshot); status != PageStatus::kOk) {
    done.code = status == PageStatus::kReadError ? errno : MDB_CORRUPTED;
    return done;
  }
  MDB_txn* txn = nullptr;
  done.code = mdb_txn_begin(env_, nullptr, 0, &txn);
  if (done.code != 0) return done;

  int code = 0;
  for (std::size_t i = 0; code == 0 && i < work.removes.size(); ++i) code = remove_entry(txn, snapshot, work.removes[i]);
  for (std::size_t i = 0; code == 0 && i < work.touches.size(); ++i) code = touch(txn, work.touches[i]);

  // Old values of the same keys go first, so that everything deleted here lies in committed pages.
  std::vector<const CacheWrite*> wanted;
  std::uint64_t needed_bytes = work.extra_bytes;
  for (const CacheWrite& write : work.writes) {
    if (code != 0) break;
    // A key that this very batch removes is still in the snapshot, so the row in the transaction is asked first.
    const std::string name = bytes_of_key(write.key);
    MDB_val name_val = val(name), row_val{};
    code = mdb_get(txn, rows_, &name_val, &row_val);
    if (code == 0 && is_stored(snapshot, write)) continue;
    if (code != 0 && code != MDB_NOTFOUND) break;
    code = remove_entry(txn, snapshot, write.key);
    wanted.push_back(&write);
    needed_bytes += disk_charge(write.tile->body.size(), write.tag.size());
  }
  if (code == 0) code = evict(txn, snapshot, budget_bytes_ - std::min(needed_bytes, budget_bytes_), done.evictions);
  for (std::size_t i = 0; code == 0 && i < wanted.size(); ++i) code = write(txn, *wanted[i]);
  done.code = commit(txn, code);
  done.writes = wanted.size();
  return done;
}

// LMDB frees the pages that a large value's header names, so that header must be right before a delete.
int CacheEnv::mend(const LmdbSnapshot& snapshot, const CacheKey& key) const {
  LmdbTree tree;
  LmdbNode node;
  char page[LmdbPages::kMaxPageBytes];
  PageStatus status = pages_.named_tree(snapshot, "blobs", tree);
  if (status == PageStatus::kOk) status = pages_.find(snapshot, tree, bytes_of_key(key), page, node);
  if (status == PageStatus::kOk && node.is_large) status = pages_.mend_large(node);
  if (status == PageStatus::kOk || status == PageStatus::kAbsent) return 0;
  return status == PageStatus::kDamaged ? MDB_CORRUPTED : EIO;
}

int CacheEnv::remove_entry(MDB_txn* txn, const LmdbSnapshot& snapshot, const CacheKey& key) {
  const std::string name = bytes_of_key(key);
  MDB_val name_val = val(name), row_val{};
  int code = mdb_get(txn, rows_, &name_val, &row_val);
  if (code == MDB_NOTFOUND) return 0;
  if (code != 0) return code;
  CacheRow row;
  if (row_of_bytes(name, view(row_val), row)) bytes_ -= std::min<std::uint64_t>(bytes_, row.charge);
  entries_ -= entries_ > 0;
  code = mend(snapshot, key);
  if (code == 0) code = mdb_del(txn, rows_, &name_val, nullptr);
  if (code == 0) code = mdb_del(txn, blobs_, &name_val, nullptr);
  return code == MDB_NOTFOUND ? MDB_CORRUPTED : code;
}

int CacheEnv::touch(MDB_txn* txn, const CacheKey& key) {
  const std::string name = bytes_of_key(key);
  MDB_val name_val = val(name), row_val{};
  const int code = mdb_get(txn, rows_, &name_val, &row_val);
  if (code != 0) return code == MDB_NOTFOUND ? 0 : code;
  CacheRow row;
  if (!row_of_bytes(name, view(row_val), row) || row.clock >= kMaxClock) return 0;
  ++row.clock;
  const std::string bytes = bytes_of_row(name, row);
  row_val = val(bytes);
  return mdb_put(txn, rows_, &name_val, &row_val, 0);
}

// The hand walks over the rows: an entry with turns left loses one, one without goes.
int CacheEnv::evict(MDB_txn* txn, const LmdbSnapshot& snapshot, std::uint64_t allowed_bytes, std::uint64_t& evictions) {
  if (bytes_ <= allowed_bytes) return 0;
  MDB_cursor* cursor = nullptr;
  int code = mdb_cursor_open(txn, rows_, &cursor);
  if (code != 0) return code;
  MDB_cursor_op step = MDB_SET_RANGE;
  while (bytes_ > allowed_bytes) {
    MDB_val name_val = val(hand_), row_val{};
    code = mdb_cursor_get(cursor, &name_val, &row_val, hand_.empty() && step == MDB_SET_RANGE ? MDB_FIRST : step);
    if (code == MDB_NOTFOUND && (step == MDB_NEXT || !hand_.empty())) {
      hand_.clear();
      step = MDB_SET_RANGE;
      continue;
    }
    if (code != 0) break;  // MDB_NOTFOUND from the very start: no rows left
    const std::string name(view(name_val));
    CacheRow row;
    if (row_of_bytes(name, view(row_val), row) && row.clock > 0) {
      --row.clock;
      const std::string bytes = bytes_of_row(name, row);
      row_val = val(bytes);
      name_val = val(name);
      code = mdb_cursor_put(cursor, &name_val, &row_val, MDB_CURRENT);
      hand_ = name;
      step = MDB_NEXT;
    } else {
      code = remove_entry(txn, snapshot, key_of_bytes(name));
      ++evictions;
      hand_ = name;
      step = MDB_SET_RANGE;
    }
    if (code != 0) break;
  }
  mdb_cursor_close(cursor);
  if (code == MDB_NOTFOUND) {
    bytes_ = entries_ = 0;
    code = 0;
  }
  return code;
}

bool CacheEnv::is_stored(const LmdbSnapshot& snapshot, const CacheWrite& write) const {
  LmdbTree tree;
  LmdbNode node;
  char page[LmdbPages::kMaxPageBytes];
  const std::string name = bytes_of_key(write.key);
  if (pages_.named_tree(snapshot, "blobs", tree) != PageStatus::kOk || pages_.find(snapshot, tree, name, page, node) != PageStatus::kOk) return false;
  if (node.size != kValueHeadBytes + write.tile->body.size()) return false;
  std::string stored(node.value);
  if (node.is_large) {
    stored.resize(node.size);
    if (pages_.read_large(node, stored.data(), stored.size(), nullptr, 0) != PageStatus::kOk) return false;
  }
  char head[kValueHeadBytes];
  make_value_head(name, *write.tile, head);
  if (stored.compare(0, sizeof head, head, sizeof head) != 0 || stored.compare(sizeof head, std::string::npos, write.tile->body) != 0) return false;
  if (pages_.named_tree(snapshot, "rows", tree) != PageStatus::kOk || pages_.find(snapshot, tree, name, page, node) != PageStatus::kOk) return false;
  CacheRow row;
  return row_of_bytes(name, node.value, row) && row.tag == write.tag;
}

int CacheEnv::write(MDB_txn* txn, const CacheWrite& write) {
  const std::string name = bytes_of_key(write.key);
  char head[kValueHeadBytes];
  make_value_head(name, *write.tile, head);
  MDB_val name_val = val(name), value{sizeof head + write.tile->body.size(), nullptr};
  int code = mdb_put(txn, blobs_, &name_val, &value, MDB_RESERVE);
  if (code != 0) return code;
  std::memcpy(value.mv_data, head, sizeof head);
  std::memcpy(static_cast<char*>(value.mv_data) + sizeof head, write.tile->body.data(), write.tile->body.size());
  const std::uint64_t charge = disk_charge(write.tile->body.size(), write.tag.size());
  const std::string row = bytes_of_row(name, {static_cast<std::uint32_t>(charge), 1, write.tag});
  MDB_val row_val = val(row);
  code = mdb_put(txn, rows_, &name_val, &row_val, 0);
  bytes_ += charge;
  ++entries_;
  return code;
}

CacheEnv::Done CacheEnv::purge_checked(const std::string& tag, std::string& from, std::size_t limit, std::uint64_t& removed) {
  Done done;
  LmdbSnapshot snapshot;
  if (const PageStatus status = pages_.newest(snapshot); status != PageStatus::kOk) {
    done.code = status == PageStatus::kReadError ? errno : MDB_CORRUPTED;
    return done;
  }
  MDB_txn* txn = nullptr;
  done.code = mdb_txn_begin(env_, nullptr, 0, &txn);
  if (done.code != 0) return done;
  std::vector<CacheKey> doomed;
  MDB_cursor* cursor = nullptr;
  int code = mdb_cursor_open(txn, rows_, &cursor);
  MDB_val name_val = val(from), row_val{};
  if (code == 0) code = mdb_cursor_get(cursor, &name_val, &row_val, from.empty() ? MDB_FIRST : MDB_SET_RANGE);
  for (; code == 0 && doomed.size() < limit; code = mdb_cursor_get(cursor, &name_val, &row_val, MDB_NEXT)) {
    CacheRow row;
    const bool is_sound = row_of_bytes(view(name_val), view(row_val), row);
    const bool is_tagged = tag.empty() || row.tag == tag || (row.tag.starts_with(tag) && row.tag.substr(tag.size()).starts_with('/'));
    if (!is_sound || is_tagged) doomed.push_back(key_of_bytes(view(name_val)));
  }
  from = code == 0 ? std::string(view(name_val)) : std::string();
  if (cursor) mdb_cursor_close(cursor);
  if (code == MDB_NOTFOUND) code = 0;
  for (std::size_t i = 0; code == 0 && i < doomed.size(); ++i) code = remove_entry(txn, snapshot, doomed[i]);
  done.code = commit(txn, code);
  if (done.code == 0) removed += doomed.size();
  return done;
}

PageStatus CacheEnv::check(std::string& reason, std::vector<CacheKey>& bad_rows) {
  LmdbSnapshot snapshot;
  if (const PageStatus status = pages_.newest(snapshot); status != PageStatus::kOk) {
    reason = "a meta page";
    return status;
  }
  // Both databases must hold the same keys: they are walked in order, so hashes of the two lists do.
  const std::unique_ptr<XXH3_state_t, decltype(&XXH3_freeState)> blob_keys(XXH3_createState(), &XXH3_freeState),
      row_keys(XXH3_createState(), &XXH3_freeState);
  XXH3_64bits_reset(blob_keys.get());
  XXH3_64bits_reset(row_keys.get());
  std::uint64_t bytes = 0, entries = 0;
  const PageStatus status = pages_.check(snapshot, [&](std::string_view database, const LmdbNode& node) {
    if (database == "settings") return true;
    if (node.key.size() != kKeyBytes) return false;
    if (database == "blobs") {
      XXH3_64bits_update(blob_keys.get(), node.key.data(), kKeyBytes);
      return node.size >= kValueHeadBytes;
    }
    if (database != "rows" || node.is_large) return false;
    XXH3_64bits_update(row_keys.get(), node.key.data(), kKeyBytes);
    CacheRow row;
    if (row_of_bytes(node.key, node.value, row)) {
      bytes += row.charge;
    } else {
      bad_rows.push_back(key_of_bytes(node.key));
    }
    ++entries;
    return true;
  }, reason);
  if (status != PageStatus::kOk) return status;
  if (XXH3_64bits_digest(blob_keys.get()) != XXH3_64bits_digest(row_keys.get())) {
    reason = "values and rows of different keys";
    return PageStatus::kDamaged;
  }
  bytes_ = bytes;
  entries_ = entries;
  return PageStatus::kOk;
}

bool CacheEnv::is_in_place(std::string& reason) const {
  struct stat ours {}, there {};
  if (::fstat(fd_, &ours) != 0 || ::stat((directory_ / kDataFile).c_str(), &there) != 0 || ours.st_ino != there.st_ino ||
      ours.st_dev != there.st_dev) {
    reason = (directory_ / kDataFile).string() + " has been removed or replaced";
    return false;
  }
  if (static_cast<std::uint64_t>(ours.st_size) < file_bytes_) {
    reason = (directory_ / kDataFile).string() + " has been cut short";
    return false;
  }
  return true;
}

bool CacheEnv::is_foreign() const {
  struct stat info {};
  return ::fstat(fd_, &info) == 0 && (info.st_mtim.tv_sec != file_time_.tv_sec || info.st_mtim.tv_nsec != file_time_.tv_nsec);
}

PageStatus CacheEnv::keys(std::vector<CacheKey>& out) const {
  LmdbSnapshot snapshot;
  if (const PageStatus status = pages_.newest(snapshot); status != PageStatus::kOk) return status;
  std::string reason;
  return pages_.check(snapshot, [&](std::string_view database, const LmdbNode& node) {
    if (database == "blobs" && node.key.size() == kKeyBytes) out.push_back(key_of_bytes(node.key));
    return true;
  }, reason);
}

}  // namespace lodestone
