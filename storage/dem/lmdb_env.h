#pragma once
// LmdbEnv: one LMDB environment with one unnamed database, its errors as Results, its mapped memory bounded.

#include <lmdb.h>

#include <atomic>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <memory>
#include <mutex>
#include <span>
#include <string>
#include <vector>

#include "kernels/types/result.h"

namespace lodestone {

using ByteView = std::span<const std::uint8_t>;
inline ByteView bytes_of(std::string_view text) {
  return {reinterpret_cast<const std::uint8_t*>(text.data()), text.size()};
}
inline std::string_view text_of(ByteView bytes) {
  return {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
}

struct KeyValue {
  std::string key;
  std::vector<std::uint8_t> value;
  bool is_removal = false;
};

// Thread-safe; one writer at a time (the caller's duty).
class LmdbEnv {
 public:
  enum class Mode {
    kFrozen,   // read-only, no lock file: a published generation never changes
    kBuild,    // new, unsynced commits; call sync() before publishing
    kDurable,  // a commit that returns is on disk
  };
  // Errors: kNotFound (no data file, kFrozen), kCorrupt (not LMDB, shorter than its own header says), kIo.
  static Result<std::shared_ptr<LmdbEnv>> open(const std::filesystem::path& directory, Mode mode,
                                               std::size_t map_bytes = 0);
  ~LmdbEnv();
  LmdbEnv(const LmdbEnv&) = delete;
  LmdbEnv& operator=(const LmdbEnv&) = delete;

  // All items in one transaction.
  Result<void> write(std::span<const KeyValue> items);
  Result<void> sync();
  // Calls use(value) with bytes that live in the map until it returns. False if there is no such key.
  Result<bool> read(std::string_view key, const std::function<void(ByteView)>& use) const;
  // Every item whose key begins with `prefix`, in key order, until `use` returns false.
  Result<void> for_each(std::string_view prefix,
                        const std::function<bool(std::string_view key, ByteView value)>& use) const;
  const std::filesystem::path& file() const { return file_; }

 private:
  LmdbEnv() = default;
  Error failure(int code, const char* what) const;
  bool is_inside(const MDB_val& value) const;
  void forget_pages(std::size_t read_bytes) const;

  std::filesystem::path file_;
  MDB_env* env_ = nullptr;
  MDB_dbi dbi_ = 0;
  std::uintmax_t frozen_bytes_ = 0;  // length of a published file; 0: still growing
  mutable std::once_flag is_located_;
  mutable const std::uint8_t* map_ = nullptr;  // both set under is_located_
  mutable std::size_t map_bytes_ = 0;
  mutable std::atomic<std::size_t> read_bytes_{0};
};

}  // namespace lodestone
