#pragma once
// LayerStore: the quadtree of one layer's real heights, in LMDB. Bytes: storage/FORMAT.md.
// Layout below the data directory:
//   layers/<name>/CURRENT        text: name of the generation directory in force; replaced by rename
//   layers/<name>/<generation>/  data.mdb: tiles, flags, info, roughness
//   layers/<name>/masks/         mask sources as uploaded and their warped pixels, one LMDB environment
//   layers/<name>/lock           flock: one writer (ingest, mask change) at a time
//   lock                         flock: one daemon

#include <cstdint>
#include <filesystem>
#include <functional>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "kernels/types/height_grid.h"
#include "kernels/types/result.h"
#include "storage/dem/layer_info.h"

namespace lodestone {

// Thread-safe. Decoded tiles are kept in a shared LRU of `decoded_bytes`.
class LayerStore {
 public:
  // Opens the generation that CURRENT names. Errors: kNotFound (no such layer; lists those that exist), kCorrupt, kIo.
  static Result<std::shared_ptr<LayerStore>> open(const std::filesystem::path& data_dir, const std::string& name,
                                                  std::size_t decoded_bytes = std::size_t{64} << 20);
  virtual ~LayerStore() = default;

  virtual const LayerInfo& info() const = 0;
  // Text that the ingest's finish hook left (JSON of the roughness models); empty if none.
  virtual std::string roughness_json() const = 0;

  // Heights of posts `window` of `level` (0..base_level), global indices of that level. Posts outside world_at(level) are
  // mirrored at its border, then clamped. Void posts hold the nearest surveyed height and are flagged.
  // Errors: kCorrupt (checksum; names tile and file, counted by corrupt_values()), kNotFound, kIo.
  virtual Result<HeightGrid> read_window(int level, const PostWindow& window) const = 0;
  // True when some post of base-level `window` (mirrored as above) is void, without decoding heights where tiles say "no voids".
  virtual Result<bool> has_voids(const PostWindow& window) const = 0;
  virtual std::uint64_t corrupt_values() const = 0;
};

// Names of the layers below data_dir, sorted; directories without CURRENT are not layers.
std::vector<std::string> list_layers(const std::filesystem::path& data_dir);

struct VerifyReport {
  std::int64_t values = 0, bytes = 0;
  std::vector<std::string> problems;  // one line each: what, where, what to do
};
// Reads every value of a layer (tiles, info, masks) and checks checksum, shape and that all tiles of all levels are there.
Result<VerifyReport> verify_layer(const std::filesystem::path& data_dir, const std::string& name,
                                  const std::function<void(double)>& progress);

// Exclusive advisory lock on a file (flock), freed by the destructor and by the kernel when the process dies.
class FileLock {
 public:
  // Error: kConflict: "<what> is in use by process <pid>: ..." when another process holds it.
  static Result<FileLock> acquire(const std::filesystem::path& path, const std::string& what);
  FileLock(FileLock&& other) noexcept;
  FileLock& operator=(FileLock&& other) noexcept;
  ~FileLock();

 private:
  explicit FileLock(int fd) : fd_(fd) {}
  int fd_ = -1;
};

}  // namespace lodestone
