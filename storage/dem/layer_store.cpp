#include "storage/dem/layer_store.h"

#include <fcntl.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <fstream>
#include <optional>

#include "storage/dem/layer_files.h"
#include "storage/dem/tile_reader.h"

namespace lodestone {
namespace {

constexpr std::int64_t kMaxWindowPosts = std::int64_t{1} << 28;

// Source index of every index lo..hi: mirrored at the world's border, then clamped.
std::vector<std::int64_t> sources_of(std::int64_t lo, std::int64_t hi, std::int64_t world_lo,
                                     std::int64_t world_hi) {
  std::vector<std::int64_t> source;
  source.reserve(static_cast<std::size_t>(hi - lo + 1));
  for (std::int64_t i = lo; i <= hi; ++i) source.push_back(mirrored(i, world_lo, world_hi));
  return source;
}

class LmdbLayerStore final : public LayerStore {
 public:
  LmdbLayerStore(std::shared_ptr<const LmdbEnv> env, LayerInfo info, std::string roughness,
                 std::size_t decoded_bytes)
      : info_(std::move(info)),
        roughness_(std::move(roughness)),
        reader_(std::move(env), info_, decoded_bytes) {}

  const LayerInfo& info() const override { return info_; }
  std::string roughness_json() const override { return roughness_; }
  std::uint64_t corrupt_values() const override { return reader_.corrupt_values(); }

  Result<HeightGrid> read_window(int level, const PostWindow& window) const override {
    if (auto ok = check(level, window); !ok) return ok.error();
    const PostWindow world = info_.world_at(level);
    if (intersection(window, world) == window) return reader_.window(level, window);

    // Read what lies under the window once mirrored, then spread it.
    const auto column = sources_of(window.i0, window.i1, world.i0, world.i1);
    const auto row = sources_of(window.j0, window.j1, world.j0, world.j1);
    const auto [c0, c1] = std::minmax_element(column.begin(), column.end());
    const auto [r0, r1] = std::minmax_element(row.begin(), row.end());
    auto inside = reader_.window(level, {*c0, *r0, *c1, *r1});
    if (!inside) return inside;
    HeightGrid out;
    out.window = window;
    out.heights_m.reserve(column.size() * row.size());
    const bool has_voids = !inside->is_void.empty();
    for (const std::int64_t j : row) {
      for (const std::int64_t i : column) {
        const std::size_t from = inside->index(i, j);
        out.heights_m.push_back(inside->heights_m[from]);
        if (has_voids) out.is_void.push_back(inside->is_void[from]);
      }
    }
    if (std::find(out.is_void.begin(), out.is_void.end(), std::uint8_t{1}) == out.is_void.end())
      out.is_void.clear();
    return out;
  }

  Result<bool> has_voids(const PostWindow& window) const override {
    const int level = info_.base_level;
    if (auto ok = check(level, window); !ok) return ok.error();
    const PostWindow world = info_.world;
    // Mirroring keeps a stretch in one piece.
    const auto span = [](std::int64_t lo, std::int64_t hi, std::int64_t world_lo, std::int64_t world_hi) {
      const auto source = sources_of(lo, hi, world_lo, world_hi);
      const auto [first, last] = std::minmax_element(source.begin(), source.end());
      return std::pair{*first, *last};
    };
    const auto [i0, i1] = span(window.i0, window.i1, world.i0, world.i1);
    const auto [j0, j1] = span(window.j0, window.j1, world.j0, world.j1);
    const std::int64_t n = info_.cells_per_tile();
    const PostWindow tiles = info_.tiles_at(level);
    const auto last = [n](std::int64_t lo, std::int64_t hi) { return (hi > lo ? hi - 1 : lo) / n; };
    for (std::int64_t y = std::clamp(j0 / n, tiles.j0, tiles.j1);
         y <= std::clamp(last(j0, j1), tiles.j0, tiles.j1); ++y) {
      for (std::int64_t x = std::clamp(i0 / n, tiles.i0, tiles.i1);
           x <= std::clamp(last(i0, i1), tiles.i0, tiles.i1); ++x) {
        const TileId id{level, x, y};
        auto mode = reader_.void_mode(id);
        if (!mode) return mode.error();
        if (*mode == VoidMode::kNone) continue;
        if (*mode == VoidMode::kAll) return true;
        auto tile = reader_.tile(id);
        if (!tile) return tile.error();
        const PostWindow part = intersection((*tile)->window, {i0, j0, i1, j1});
        for (std::int64_t j = part.j0; j <= part.j1; ++j) {
          for (std::int64_t i = part.i0; i <= part.i1; ++i) {
            if ((*tile)->void_at(i, j)) return true;
          }
        }
      }
    }
    return false;
  }

 private:
  Result<void> check(int level, const PostWindow& window) const {
    if (level < 0 || level > info_.base_level) {
      return Error{ErrorCode::kNotFound, "layer " + info_.name + " stores levels 0 to " +
                                             std::to_string(info_.base_level) + ", level " +
                                             std::to_string(level) + " was asked for"};
    }
    if (window.is_empty() || window.width() > kMaxWindowPosts / window.height()) {
      return Error{ErrorCode::kTooLarge, "layer " + info_.name + ": a window holds 1 to " +
                                             std::to_string(kMaxWindowPosts) + " posts"};
    }
    return {};
  }

  const LayerInfo info_;
  const std::string roughness_;
  const TileReader reader_;
};

}  // namespace

std::filesystem::path layer_directory(const std::filesystem::path& data_dir, const std::string& name) {
  return data_dir / "layers" / name;
}

Result<std::filesystem::path> current_generation(const std::filesystem::path& data_dir,
                                                 const std::string& name) {
  if (auto ok = check_name("layer", name); !ok) return ok.error();
  const std::filesystem::path directory = layer_directory(data_dir, name);
  std::ifstream in(directory / "CURRENT");
  std::string generation;
  if (!in) {
    std::string known;
    for (const std::string& layer : list_layers(data_dir)) known += (known.empty() ? "" : ", ") + layer;
    return Error{ErrorCode::kNotFound, "layer \"" + name + "\" does not exist; there " +
                                           (known.empty() ? std::string("are none yet") : "are: " + known)};
  }
  std::getline(in, generation);
  if (!check_name("generation", generation)) {
    return Error{ErrorCode::kCorrupt,
                 (directory / "CURRENT").string() + " names no generation; ingest the layer again"};
  }
  return directory / generation;
}

Result<void> sync_directory(const std::filesystem::path& directory) {
  const int fd = ::open(directory.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
  const bool ok = fd >= 0 && ::fsync(fd) == 0;
  const int reason = errno;
  if (fd >= 0) ::close(fd);
  if (!ok) return Error{ErrorCode::kIo, directory.string() + " cannot be synced: " + std::strerror(reason)};
  return {};
}

Result<void> replace_file(const std::filesystem::path& file, const std::string& text) {
  const std::filesystem::path temporary = file.string() + ".tmp";
  const int fd = ::open(temporary.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0644);
  const bool is_written = fd >= 0 &&
                          ::write(fd, text.data(), text.size()) == static_cast<ssize_t>(text.size()) &&
                          ::fsync(fd) == 0;
  const int reason = errno;
  if (fd >= 0) ::close(fd);
  if (!is_written || ::rename(temporary.c_str(), file.c_str()) != 0) {
    const Error error{ErrorCode::kIo,
                      file.string() + " cannot be written: " + std::strerror(is_written ? errno : reason)};
    ::unlink(temporary.c_str());
    return error;
  }
  return sync_directory(file.parent_path());
}

Result<LayerInfo> read_layer_info(const LmdbEnv& env) {
  std::optional<Result<std::string>> text;
  auto found = env.read(kInfoKey, [&](ByteView value) { text = decode_text(value, kInfoKey); });
  if (!found) return found.error();
  if (!*found)
    return Error{ErrorCode::kCorrupt,
                 env.file().string() + ": layer info is missing; ingest the layer again"};
  if (!*text)
    return Error{ErrorCode::kCorrupt,
                 env.file().string() + ": layer info: " + text->error().message + "; ingest the layer again"};
  return layer_info_from_json(**text);
}

std::shared_ptr<LayerStore> store_on(std::shared_ptr<const LmdbEnv> env, LayerInfo info,
                                     std::string roughness, std::size_t decoded_bytes) {
  return std::make_shared<LmdbLayerStore>(std::move(env), std::move(info), std::move(roughness),
                                          decoded_bytes);
}

Result<std::shared_ptr<LayerStore>> LayerStore::open(const std::filesystem::path& data_dir,
                                                     const std::string& name, std::size_t decoded_bytes) {
  auto generation = current_generation(data_dir, name);
  if (!generation) return generation.error();
  auto env = LmdbEnv::open(*generation, LmdbEnv::Mode::kFrozen);
  if (!env && env.error().code == ErrorCode::kNotFound) {
    // Another process may just have published the next generation and swept this one.
    generation = current_generation(data_dir, name);
    if (!generation) return generation.error();
    env = LmdbEnv::open(*generation, LmdbEnv::Mode::kFrozen);
    if (!env) return Error{ErrorCode::kCorrupt, "layer " + name + ": " + env.error().message};
  }
  if (!env) return env.error();
  auto info = read_layer_info(**env);
  if (!info) return std::move(info.error()).within("opening layer " + name);
  std::optional<Result<std::string>> roughness;
  auto found =
      (*env)->read(kRoughnessKey, [&](ByteView value) { roughness = decode_text(value, kRoughnessKey); });
  if (!found) return found.error();
  if (*found && !*roughness) {
    return Error{ErrorCode::kCorrupt, (*env)->file().string() + ": roughness: " + roughness->error().message +
                                          "; ingest the layer again"};
  }
  return store_on(*env, std::move(*info), *found ? **roughness : std::string(), decoded_bytes);
}

std::vector<std::string> list_layers(const std::filesystem::path& data_dir) {
  std::vector<std::string> names;
  std::error_code ec;
  for (std::filesystem::directory_iterator it(data_dir / "layers", ec), end; !ec && it != end;
       it.increment(ec)) {
    std::error_code ignored;
    const std::string name = it->path().filename().string();
    if (check_name("layer", name) && std::filesystem::exists(it->path() / "CURRENT", ignored))
      names.push_back(name);
  }
  std::sort(names.begin(), names.end());
  return names;
}

}  // namespace lodestone
