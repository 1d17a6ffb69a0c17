#include "storage/dem/lmdb_env.h"

#include <sys/mman.h>

#include <algorithm>
#include <cstdio>
#include <cstring>
#include <fstream>

namespace lodestone {
namespace {

// After so many bytes read, mapped pages are let go: they stay in the page cache, but not in our resident
// set.
constexpr std::size_t kForgetEveryBytes = std::size_t{32} << 20;
constexpr unsigned kMaxReaders = 1024;

struct TxnCloser {
  void operator()(MDB_txn* txn) const noexcept { mdb_txn_abort(txn); }
};
using Txn = std::unique_ptr<MDB_txn, TxnCloser>;

MDB_val val(const void* data, std::size_t size) { return {size, const_cast<void*>(data)}; }

}  // namespace

Error LmdbEnv::failure(int code, const char* what) const {
  const bool is_damage = code == MDB_CORRUPTED || code == MDB_PAGE_NOTFOUND || code == MDB_INVALID ||
                         code == MDB_VERSION_MISMATCH || code == MDB_PANIC;
  const std::string fix = code == ENOSPC         ? "; free disk space and try again"
                          : code == MDB_MAP_FULL ? "; the store is full"
                          : is_damage            ? "; ingest the layer again"
                                                 : "";
  return Error{is_damage ? ErrorCode::kCorrupt : ErrorCode::kIo,
               file_.string() + ": " + what + ": " + mdb_strerror(code) + fix};
}

Result<std::shared_ptr<LmdbEnv>> LmdbEnv::open(const std::filesystem::path& directory, Mode mode,
                                               std::size_t map_bytes) {
  std::shared_ptr<LmdbEnv> self(new LmdbEnv);
  self->file_ = directory / "data.mdb";
  std::error_code ec;
  std::uintmax_t file_bytes = std::filesystem::file_size(self->file_, ec);
  if (ec) file_bytes = 0;
  if (mode == Mode::kFrozen && ec) {
    return Error{ErrorCode::kNotFound, self->file_.string() + " is missing; ingest the layer again"};
  }
  if (mode != Mode::kFrozen) {
    std::filesystem::create_directories(directory, ec);
    if (ec) return Error{ErrorCode::kIo, directory.string() + " cannot be made: " + ec.message()};
  }
  if (int code = mdb_env_create(&self->env_)) return self->failure(code, "opening");
  mdb_env_set_maxreaders(self->env_, kMaxReaders);
  if (map_bytes > 0) mdb_env_set_mapsize(self->env_, map_bytes);
  unsigned flags = MDB_NOTLS;
  if (mode == Mode::kFrozen) flags |= MDB_RDONLY | MDB_NOLOCK;
  if (mode == Mode::kBuild) flags |= MDB_NOSYNC | MDB_NOMETASYNC;
  if (int code = mdb_env_open(self->env_, directory.c_str(), flags, 0644))
    return self->failure(code, "opening");
  MDB_txn* raw = nullptr;
  if (int code = mdb_txn_begin(self->env_, nullptr, mode == Mode::kFrozen ? MDB_RDONLY : 0, &raw)) {
    return self->failure(code, "opening");
  }
  Txn txn(raw);
  if (int code = mdb_dbi_open(txn.get(), nullptr, 0, &self->dbi_)) return self->failure(code, "opening");
  if (int code = mdb_txn_commit(txn.release())) return self->failure(code, "opening");

  MDB_envinfo info{};
  MDB_stat stat{};
  mdb_env_info(self->env_, &info);
  mdb_env_stat(self->env_, &stat);
  if (mode == Mode::kFrozen) {
    // Pages past the end of the file would be a SIGBUS; the header knows how many there must be.
    const std::uintmax_t needed = (static_cast<std::uintmax_t>(info.me_last_pgno) + 1) * stat.ms_psize;
    if (file_bytes < needed) {
      return Error{ErrorCode::kCorrupt, self->file_.string() + ": " + std::to_string(needed) +
                                            " bytes expected, " + std::to_string(file_bytes) +
                                            " found; ingest the layer again"};
    }
    self->frozen_bytes_ = file_bytes;
  }
  return self;
}

LmdbEnv::~LmdbEnv() {
  if (env_ != nullptr) mdb_env_close(env_);
}

Result<void> LmdbEnv::write(std::span<const KeyValue> items) {
  MDB_txn* raw = nullptr;
  if (int code = mdb_txn_begin(env_, nullptr, 0, &raw)) return failure(code, "writing");
  Txn txn(raw);
  for (const KeyValue& item : items) {
    MDB_val key = val(item.key.data(), item.key.size());
    int code = 0;
    if (item.is_removal) {
      code = mdb_del(txn.get(), dbi_, &key, nullptr);
      if (code == MDB_NOTFOUND) code = 0;
    } else {
      MDB_val value = val(item.value.data(), item.value.size());
      code = mdb_put(txn.get(), dbi_, &key, &value, 0);
    }
    if (code != 0) return failure(code, "writing");
  }
  if (int code = mdb_txn_commit(txn.release())) return failure(code, "writing");
  return {};
}

Result<void> LmdbEnv::sync() {
  if (int code = mdb_env_sync(env_, 1)) return failure(code, "syncing");
  return {};
}

bool LmdbEnv::is_inside(const MDB_val& value) const {
  const auto* begin = static_cast<const std::uint8_t*>(value.mv_data);
  // LMDB does not tell where its map lies; the kernel does, for the first value read.
  std::call_once(is_located_, [&] {
    const auto address = reinterpret_cast<std::uintptr_t>(begin);
    std::ifstream maps("/proc/self/maps");
    for (std::string line; std::getline(maps, line);) {
      unsigned long long from = 0, to = 0;
      if (std::sscanf(line.c_str(), "%llx-%llx", &from, &to) != 2 || address < from || address >= to)
        continue;
      if (line.find("/data.mdb") == std::string::npos) break;
      map_ = reinterpret_cast<const std::uint8_t*>(static_cast<std::uintptr_t>(from));
      map_bytes_ = to - from;
      if (frozen_bytes_ > 0) map_bytes_ = std::min<std::size_t>(map_bytes_, frozen_bytes_);
    }
  });
  if (map_ == nullptr) return false;
  return begin >= map_ && value.mv_size <= map_bytes_ &&
         static_cast<std::size_t>(begin - map_) <= map_bytes_ - value.mv_size;
}

void LmdbEnv::forget_pages(std::size_t read_bytes) const {
  const std::size_t before = read_bytes_.fetch_add(read_bytes, std::memory_order_relaxed);
  if (before / kForgetEveryBytes != (before + read_bytes) / kForgetEveryBytes) {
    madvise(const_cast<std::uint8_t*>(map_), map_bytes_, MADV_DONTNEED);  // shared file map: nothing is lost
  }
}

Result<bool> LmdbEnv::read(std::string_view key, const std::function<void(ByteView)>& use) const {
  MDB_txn* raw = nullptr;
  if (int code = mdb_txn_begin(env_, nullptr, MDB_RDONLY, &raw)) return failure(code, "reading");
  const Txn txn(raw);
  MDB_val k = val(key.data(), key.size());
  MDB_val value{};
  const int code = mdb_get(txn.get(), dbi_, &k, &value);
  if (code == MDB_NOTFOUND) return false;
  if (code != 0) return failure(code, "reading");
  if (!is_inside(value)) return failure(MDB_CORRUPTED, "reading");
  use({static_cast<const std::uint8_t*>(value.mv_data), value.mv_size});
  forget_pages(value.mv_size);
  return true;
}

Result<void> LmdbEnv::for_each(std::string_view prefix,
                               const std::function<bool(std::string_view, ByteView)>& use) const {
  MDB_txn* raw = nullptr;
  if (int code = mdb_txn_begin(env_, nullptr, MDB_RDONLY, &raw)) return failure(code, "reading");
  const Txn txn(raw);
  MDB_cursor* cursor = nullptr;
  if (int code = mdb_cursor_open(txn.get(), dbi_, &cursor)) return failure(code, "reading");
  const std::unique_ptr<MDB_cursor, decltype(&mdb_cursor_close)> closer(cursor, &mdb_cursor_close);
  MDB_val key = val(prefix.data(), prefix.size());
  MDB_val value{};
  int code = mdb_cursor_get(cursor, &key, &value, prefix.empty() ? MDB_FIRST : MDB_SET_RANGE);
  for (; code == 0; code = mdb_cursor_get(cursor, &key, &value, MDB_NEXT)) {
    if (!is_inside(value) || !is_inside(key)) return failure(MDB_CORRUPTED, "reading");
    const std::string_view name(static_cast<const char*>(key.mv_data), key.mv_size);
    if (name.substr(0, prefix.size()) != prefix) return {};
    if (!use(name, {static_cast<const std::uint8_t*>(value.mv_data), value.mv_size})) return {};
    forget_pages(value.mv_size);
  }
  if (code != MDB_NOTFOUND) return failure(code, "reading");
  return {};
}

}  // namespace lodestone
