#include "storage/dem/mask_store.h"

#include <cpl_conv.h>
#include <cpl_string.h>
#include <cpl_vsi.h>
#include <gdal_priv.h>
#include <ogr_spatialref.h>
#include <xxhash.h>
#include <zstd.h>

#include <algorithm>
#include <atomic>
#include <cstring>
#include <list>
#include <map>
#include <mutex>
#include <nlohmann/json.hpp>
#include <optional>

#include "storage/dem/layer_files.h"
#include "storage/dem/lmdb_env.h"
#include "storage/dem/mask_files.h"
#include "storage/dem/mask_grid.h"
#include "storage/dem/raster_source.h"
#include "storage/dem/tile_codec.h"

namespace lodestone {
namespace {

using nlohmann::json;

constexpr std::size_t kMapBytes = std::size_t{1} << 36;  // address space, not memory
constexpr std::size_t kTilePixels = std::size_t{kMaskTile} * kMaskTile;
constexpr std::size_t kCachedTiles = 512;  // 32 MiB
constexpr std::int64_t kMaxCropPixels = std::int64_t{1} << 28;

// Keys (storage/FORMAT.md): 's' name; 'm' grid name; 'p' grid name 0 row column.
std::string source_key(const std::string& name) { return "s" + name; }
std::string info_key(const std::string& grid, const std::string& name) { return "m" + grid + name; }
std::string pixels_prefix(const std::string& grid, const std::string& name) {
  return "p" + grid + name + '\0';
}
std::string pixels_key(const std::string& grid, const std::string& name, std::int64_t row,
                       std::int64_t column) {
  std::string key = pixels_prefix(grid, name);
  for (const std::int64_t v : {row, column}) {
    for (int shift = 24; shift >= 0; shift -= 8) key += static_cast<char>(v >> shift);
  }
  return key;
}

// Pixels of one tile: one byte when uniform, else a zstd frame; wrapped like every text.
std::vector<std::uint8_t> encode_pixels(const std::vector<std::uint8_t>& pixels, const std::string& key) {
  if (std::all_of(pixels.begin(), pixels.end(), [&](std::uint8_t v) { return v == pixels[0]; })) {
    return encode_text({reinterpret_cast<const char*>(pixels.data()), 1}, key);
  }
  std::string packed(ZSTD_compressBound(pixels.size()), '\0');
  packed.resize(ZSTD_compress(packed.data(), packed.size(), pixels.data(), pixels.size(), 3));
  return encode_text(packed, key);
}

Result<std::vector<std::uint8_t>> decode_pixels(ByteView value, const std::string& key) {
  auto text = decode_text(value, key);
  if (!text) return text.error();
  if (text->size() == 1) return std::vector<std::uint8_t>(kTilePixels, static_cast<std::uint8_t>((*text)[0]));
  std::vector<std::uint8_t> pixels(kTilePixels);
  if (ZSTD_decompress(pixels.data(), pixels.size(), text->data(), text->size()) != kTilePixels) {
    return Error{ErrorCode::kCorrupt, "pixels do not unpack"};
  }
  return pixels;
}

// What is stored about one mask.
struct Record {
  MaskInfo info;
  std::uint64_t pixels_hash = 0;
  std::int64_t tiles = 0;  // stored; all others are 0
};

std::string record_text(const Record& r) {
  return json{{"level", r.info.level}, {"source_hash", r.info.source_hash},
              {"width", r.info.width}, {"height", r.info.height},
              {"mean", r.info.mean},   {"pixels_hash", r.pixels_hash},
              {"tiles", r.tiles}}
      .dump();
}

Result<Record> record_from(ByteView value, const std::string& key, const std::string& name) {
  auto text = decode_text(value, key);
  if (!text) return text.error();
  try {
    const json object = json::parse(*text);
    Record r;
    r.info.name = name;
    object.at("level").get_to(r.info.level);
    object.at("source_hash").get_to(r.info.source_hash);
    object.at("width").get_to(r.info.width);
    object.at("height").get_to(r.info.height);
    object.at("mean").get_to(r.info.mean);
    object.at("pixels_hash").get_to(r.pixels_hash);
    object.at("tiles").get_to(r.tiles);
    return r;
  } catch (const json::exception& e) {
    return Error{ErrorCode::kCorrupt, e.what()};
  }
}

// LMDB allows one environment per file and process: all stores of a layer share it.
Result<std::shared_ptr<LmdbEnv>> shared_env(const std::filesystem::path& directory) {
  static std::mutex mutex;
  static std::map<std::string, std::weak_ptr<LmdbEnv>> open_envs;
  std::error_code ec;
  std::filesystem::create_directories(directory, ec);
  const std::string path = std::filesystem::weakly_canonical(directory, ec).string();
  const std::lock_guard lock(mutex);
  if (auto env = open_envs[path].lock()) return env;
  auto env = LmdbEnv::open(directory, LmdbEnv::Mode::kDurable, kMapBytes);
  if (env) open_envs[path] = *env;
  return env;
}

// Eight characters that change with the layer's grid: masks of another grid are other masks.
std::string grid_id(const LayerInfo& layer) {
  json text = {layer.crs_wkt,
               layer.transform,
               {layer.world.i0, layer.world.j0, layer.world.i1, layer.world.j1},
               layer.base_level};
  const std::string s = text.dump(-1, ' ', false, json::error_handler_t::replace);
  const std::uint64_t hash = XXH3_64bits(s.data(), s.size());
  std::string id;
  for (int shift = 0; shift < 64; shift += 8) id += static_cast<char>('a' + (hash >> shift) % 26);
  return id;
}

// Names under a one-letter prefix with `skip` characters before the name.
Result<std::vector<std::string>> names_under(const LmdbEnv& env, const std::string& prefix,
                                             std::size_t skip) {
  std::vector<std::string> names;
  auto ok = env.for_each(prefix, [&](std::string_view key, ByteView) {
    names.emplace_back(key.substr(std::min(skip, key.size())));
    return true;
  });
  if (!ok) return ok.error();
  return names;
}

// Removals of all that is stored of `name` in every grid but its source.
Result<std::vector<KeyValue>> removals_of(const LmdbEnv& env, const std::string& name) {
  std::vector<KeyValue> items;
  for (const char* letter : {"m", "p"}) {
    auto ok = env.for_each(letter, [&](std::string_view key, ByteView) {
      if (key.size() < 9) return true;
      const std::string_view rest = key.substr(9);
      const bool is_ours = letter[0] == 'm'
                               ? rest == name
                               : rest.size() == name.size() + 9 && rest.substr(0, name.size()) == name &&
                                     rest[name.size()] == '\0';
      if (is_ours) items.push_back({std::string(key), {}, true});
      return true;
    });
    if (!ok) return ok.error();
  }
  return items;
}

// Appends the puts of a warped mask.
Record append_mask(std::vector<KeyValue>& items, const LayerInfo& layer, const std::string& name,
                   const WarpedMask& mask, std::uint64_t source_hash) {
  const std::string grid = grid_id(layer);
  Record r;
  r.info = {name,
            mask.level,
            source_hash,
            mask_pixels(layer.world.width() - 1, mask.level),
            mask_pixels(layer.world.height() - 1, mask.level),
            mask.mean};
  r.tiles = static_cast<std::int64_t>(mask.tiles.size());
  for (const auto& [place, pixels] : mask.tiles) {
    const std::string key = pixels_key(grid, name, place.first, place.second);
    r.pixels_hash = XXH3_64bits_withSeed(pixels.data(), pixels.size(),
                                         r.pixels_hash ^ XXH3_64bits(key.data(), key.size()));
    items.push_back({key, encode_pixels(pixels, key)});
  }
  const std::string key = info_key(grid, name);
  items.push_back({key, encode_text(record_text(r), key)});
  return r;
}

// Masks that have a source, but no pixels for this layer's grid: warp them. The layer's lock is held.
Result<void> warp_missing(LmdbEnv& env, const LayerInfo& layer, const std::vector<std::string>& names) {
  for (const std::string& name : names) {
    const std::string key = source_key(name);
    std::optional<Result<std::string>> source;
    auto found = env.read(key, [&](ByteView value) { source = decode_text(value, key); });
    if (!found) return found.error();
    if (!*found) continue;
    if (!*source)
      return Error{ErrorCode::kCorrupt, env.file().string() + ": mask " + name + ": " +
                                            source->error().message + "; put it again"};
    auto grey = decode_mask(bytes_of(**source));
    if (!grey) return std::move(grey.error()).within("warping mask " + name);
    auto mask = warp_mask(*grey, layer);
    // A mask that lies beside the new ground has nothing left to hide.
    if (!mask && mask.error().code == ErrorCode::kInvalidArgument) mask = WarpedMask{};
    if (!mask) return std::move(mask.error()).within("warping mask " + name);
    std::vector<KeyValue> items;
    append_mask(items, layer, name, *mask, XXH3_64bits((*source)->data(), (*source)->size()));
    if (auto ok = env.write(items); !ok) return ok;
  }
  return {};
}

class LmdbMaskStore final : public MaskStore {
 public:
  LmdbMaskStore(const std::filesystem::path& data_dir, const LayerInfo& layer, std::shared_ptr<LmdbEnv> env)
      : lock_path_(layer_directory(data_dir, layer.name) / "lock"),
        layer_(layer),
        grid_(grid_id(layer)),
        env_(std::move(env)) {}

  Result<void> load() {
    auto sources = names_under(*env_, "s", 1);
    if (!sources) return sources.error();
    std::vector<std::string> missing;
    for (const std::string& name : *sources) {
      auto found = env_->read(info_key(grid_, name), [](ByteView) {});
      if (!found) return found.error();
      if (!*found) missing.push_back(name);
    }
    if (!missing.empty()) {
      auto lock = FileLock::acquire(lock_path_, "layer " + layer_.name);
      if (!lock) return lock.error();
      if (auto ok = warp_missing(*env_, layer_, missing); !ok) return ok;
    }
    for (const std::string& name : *sources) {
      const std::string key = info_key(grid_, name);
      std::optional<Result<Record>> record;
      auto found = env_->read(key, [&](ByteView value) { record = record_from(value, key, name); });
      if (!found) return found.error();
      if (!*found) continue;
      if (!*record) return damaged(name, record->error().message);
      records_[name] = **record;
    }
    return {};
  }

  std::vector<MaskInfo> list() const override {
    const std::lock_guard lock(mutex_);
    std::vector<MaskInfo> all;
    for (const auto& [name, record] : records_) all.push_back(record.info);
    return all;
  }

  Result<MaskInfo> put(const std::string& name, std::span<const std::uint8_t> bytes) override {
    if (auto ok = check_name("mask", name); !ok) return ok.error();
    auto grey = decode_mask(bytes);
    if (!grey) return grey.error();
    auto mask = warp_mask(*grey, layer_);
    if (!mask) return mask.error();
    auto writer = FileLock::acquire(lock_path_, "layer " + layer_.name);
    if (!writer) return writer.error();
    auto items = removals_of(*env_, name);
    if (!items) return items.error();
    const std::string key = source_key(name);
    items->push_back({key, encode_text(text_of(bytes), key)});
    const Record record = append_mask(*items, layer_, name, *mask, XXH3_64bits(bytes.data(), bytes.size()));
    if (auto ok = env_->write(*items); !ok) return ok.error();
    const std::lock_guard lock(mutex_);
    forget(name);
    records_[name] = record;
    return record.info;
  }

  Result<void> remove(const std::string& name) override {
    auto writer = FileLock::acquire(lock_path_, "layer " + layer_.name);
    if (!writer) return writer.error();
    if (auto known = record_of(name); !known) return known.error();
    auto items = removals_of(*env_, name);
    if (!items) return items.error();
    items->push_back({source_key(name), {}, true});
    if (auto ok = env_->write(*items); !ok) return ok;
    const std::lock_guard lock(mutex_);
    forget(name);
    records_.erase(name);
    return {};
  }

  Result<std::string> get(const std::string& name, const std::string& extension) const override;

  Result<MaskCrop> crop(std::span<const std::string> names, int level,
                        const PostWindow& window) const override {
    if (window.is_empty() || window.width() > kMaxCropPixels / window.height()) {
      return Error{ErrorCode::kTooLarge, "mask: a crop holds 1 to 2^28 pixels"};
    }
    MaskCrop out{
        level, window.i0, window.j0, static_cast<int>(window.width()), static_cast<int>(window.height()), {}};
    out.pixels.resize(static_cast<std::size_t>(window.width() * window.height()));
    for (const std::string& name : names) {
      auto record = record_of(name);
      if (!record) return record.error();
      if (auto ok = unite(*record, out); !ok) return ok.error();
    }
    return out;
  }

  Result<int> finest_level(std::span<const std::string> names) const override {
    std::optional<int> finest;
    for (const std::string& name : names) {
      auto record = record_of(name);
      if (!record) return record.error();
      finest = std::max(finest.value_or(record->info.level), record->info.level);
    }
    return finest.value_or(0);
  }

  std::uint64_t digest() const override {
    const std::lock_guard lock(mutex_);
    std::uint64_t hash = 0;
    for (const auto& [name, r] : records_) {
      const std::string text =
          name + '\0' + std::to_string(r.info.level) + '\0' + std::to_string(r.pixels_hash);
      hash = XXH3_64bits_withSeed(text.data(), text.size(), hash);
    }
    return hash;
  }

 private:
  using TilePtr = std::shared_ptr<const std::vector<std::uint8_t>>;
  using Cache = std::list<std::pair<std::string, TilePtr>>;

  Error damaged(const std::string& name, const std::string& why) const {
    return Error{ErrorCode::kCorrupt, env_->file().string() + ": mask " + name + " of layer " + layer_.name +
                                          ": " + why + "; put it again"};
  }

  Result<Record> record_of(const std::string& name) const {
    const std::lock_guard lock(mutex_);
    const auto found = records_.find(name);
    if (found != records_.end()) return found->second;
    std::string known;
    for (const auto& [other, record] : records_) known += (known.empty() ? "" : ", ") + other;
    return Error{ErrorCode::kNotFound, "mask \"" + name + "\" does not exist in layer " + layer_.name +
                                           "; there " +
                                           (known.empty() ? std::string("are none") : "are: " + known)};
  }

  void forget(const std::string& name) {  // mutex_ is held
    const std::string prefix = pixels_prefix(grid_, name);
    for (auto it = recent_first_.begin(); it != recent_first_.end();) {
      if (it->first.compare(0, prefix.size(), prefix) == 0) {
        by_key_.erase(it->first);
        it = recent_first_.erase(it);
      } else {
        ++it;
      }
    }
    ++changes_;
  }

  // Pixels of a tile, or null where the mask is 0.
  Result<TilePtr> tile(const std::string& name, std::int64_t row, std::int64_t column) const {
    const std::string key = pixels_key(grid_, name, row, column);
    std::uint64_t changes = 0;
    {
      const std::lock_guard lock(mutex_);
      if (const auto found = by_key_.find(key); found != by_key_.end()) {
        recent_first_.splice(recent_first_.begin(), recent_first_, found->second);
        return found->second->second;
      }
      changes = changes_;
    }
    std::optional<Result<std::vector<std::uint8_t>>> pixels;
    auto found = env_->read(key, [&](ByteView value) { pixels = decode_pixels(value, key); });
    if (!found) return found.error();
    TilePtr tile;
    if (*found) {
      if (!*pixels) return damaged(name, pixels->error().message);
      tile = std::make_shared<const std::vector<std::uint8_t>>(std::move(**pixels));
    }
    const std::lock_guard lock(mutex_);
    if (changes != changes_ || by_key_.contains(key)) return tile;
    recent_first_.emplace_front(key, tile);
    by_key_[key] = recent_first_.begin();
    if (recent_first_.size() > kCachedTiles) {
      by_key_.erase(recent_first_.back().first);
      recent_first_.pop_back();
    }
    return tile;
  }

  // Raises the crop's pixels to those of one mask.
  Result<void> unite(const Record& record, MaskCrop& out) const {
    const int mu = record.info.level;
    const int finer = std::max(mu - out.level, 0), coarser = std::max(out.level - mu, 0);
    const std::int64_t width = record.info.width, height = record.info.height;
    // Pixels are areas: the mirror lies on the world's edge, between pixels.
    const auto mirror = [](std::int64_t p, std::int64_t count) {
      if (p < 0) p = -1 - p;
      if (p >= count) p = 2 * count - 1 - p;
      return std::clamp<std::int64_t>(p, 0, count - 1);
    };
    // A pixel beyond the world at the crop's level mirrors there first, so that coarse pixels cut by the edge
    // stay what they are.
    const std::int64_t out_width = mask_pixels(layer_.world.width() - 1, out.level),
                       out_height = mask_pixels(layer_.world.height() - 1, out.level);
    std::int64_t at_row = -1, at_column = -1;
    TilePtr current;
    const auto pixel = [&](std::int64_t x, std::int64_t y) -> Result<int> {
      const std::int64_t row = y / kMaskTile, column = x / kMaskTile;
      if (row != at_row || column != at_column) {
        auto next = tile(record.info.name, row, column);
        if (!next) return next.error();
        current = *next;
        at_row = row;
        at_column = column;
      }
      return current ? (*current)[static_cast<std::size_t>((y % kMaskTile) * kMaskTile + x % kMaskTile)] : 0;
    };
    const std::int64_t side = std::int64_t{1} << finer;
    for (int r = 0; r < out.height; ++r) {
      const std::int64_t y = mirror(out.j0 + r, out_height);
      for (int c = 0; c < out.width; ++c) {
        const std::int64_t x = mirror(out.i0 + c, out_width);
        std::int64_t sum = 0;
        for (std::int64_t v = 0; v < side; ++v) {
          for (std::int64_t u = 0; u < side; ++u) {
            auto value = pixel(mirror((x << finer >> coarser) + u, width),
                               mirror((y << finer >> coarser) + v, height));
            if (!value) return value.error();
            sum += *value;
          }
        }
        const auto mean = static_cast<std::uint8_t>((sum + side * side / 2) >> (2 * finer));
        std::uint8_t& to = out.pixels[static_cast<std::size_t>(r) * static_cast<std::size_t>(out.width) +
                                      static_cast<std::size_t>(c)];
        to = std::max(to, mean);
      }
    }
    return {};
  }

  const std::filesystem::path lock_path_;
  const LayerInfo layer_;
  const std::string grid_;
  const std::shared_ptr<LmdbEnv> env_;
  mutable std::mutex mutex_;  // guards all below
  std::map<std::string, Record> records_;
  mutable Cache recent_first_;
  mutable std::map<std::string, Cache::iterator> by_key_;
  std::uint64_t changes_ = 0;
};

Result<std::string> LmdbMaskStore::get(const std::string& name, const std::string& extension) const {
  if (extension != "tif" && extension != "png")
    return Error{ErrorCode::kUnsupported, "mask: given as tif or png, not " + extension};
  auto record = record_of(name);
  if (!record) return record.error();
  const std::int64_t width = record->info.width, height = record->info.height;
  if (width > kMaxCropPixels / 4 / height) {
    return Error{ErrorCode::kTooLarge,
                 "mask: " + std::to_string(width) + " x " + std::to_string(height) +
                     " pixels are more than 2^26; it can be used, but not given back whole"};
  }
  const std::string names[] = {name};
  auto crop_result = crop(names, record->info.level, {0, 0, width - 1, height - 1});
  if (!crop_result) return crop_result.error();

  prepare_gdal();
  const QuietGdal quiet;
  const DatasetPtr memory(GetGDALDriverManager()->GetDriverByName("MEM")->Create(
      "", static_cast<int>(width), static_cast<int>(height), 1, GDT_Byte, nullptr));
  OGRSpatialReference crs;
  crs.SetFromUserInput(layer_.crs_wkt.c_str());
  auto transform = mask_transform(layer_, record->info.level);
  const bool is_filled = memory && memory->GetRasterBand(1)->RasterIO(
                                       GF_Write, 0, 0, static_cast<int>(width), static_cast<int>(height),
                                       crop_result->pixels.data(), static_cast<int>(width),
                                       static_cast<int>(height), GDT_Byte, 0, 0, nullptr) == CE_None;
  if (!is_filled) return Error{ErrorCode::kInternal, "mask: no memory raster"};
  memory->SetSpatialRef(&crs);
  memory->SetGeoTransform(transform.data());
  const bool is_tif = extension == "tif";
  static std::atomic<std::uint64_t> serial{0};
  const std::string path = "/vsimem/lodestone-mask-out-" + std::to_string(serial++) + "." + extension;
  char** options = is_tif ? CSLAddString(nullptr, "COMPRESS=DEFLATE") : nullptr;
  DatasetPtr written(GetGDALDriverManager()
                         ->GetDriverByName(is_tif ? "GTiff" : "PNG")
                         ->CreateCopy(path.c_str(), memory.get(), 0, options, nullptr, nullptr));
  CSLDestroy(options);
  const bool is_written = written != nullptr;
  written.reset();
  vsi_l_offset size = 0;
  GByte* bytes = is_written ? VSIGetMemFileBuffer(path.c_str(), &size, TRUE) : nullptr;
  VSIUnlink((path + ".aux.xml").c_str());
  if (bytes == nullptr)
    return Error{ErrorCode::kInternal, std::string("mask: cannot be written: ") + CPLGetLastErrorMsg()};
  std::string out(reinterpret_cast<const char*>(bytes), size);
  CPLFree(bytes);
  return out;
}

}  // namespace

Result<std::shared_ptr<MaskStore>> MaskStore::open(const std::filesystem::path& data_dir,
                                                   const LayerInfo& layer) {
  auto env = shared_env(layer_directory(data_dir, layer.name) / "masks");
  if (!env) return env.error();
  auto store = std::make_shared<LmdbMaskStore>(data_dir, layer, *env);
  if (auto ok = store->load(); !ok) return ok.error();
  return std::shared_ptr<MaskStore>(std::move(store));
}

Result<void> rewarp_masks(const std::filesystem::path& data_dir, const LayerInfo& layer,
                          const LayerInfo* previous) {
  const std::filesystem::path directory = layer_directory(data_dir, layer.name) / "masks";
  std::error_code ec;
  if (!std::filesystem::exists(directory / "data.mdb", ec)) return {};
  auto env = shared_env(directory);
  if (!env) return env.error();
  // Pixels of grids that neither the new nor the old generation uses.
  const std::string kept = grid_id(layer), old = previous != nullptr ? grid_id(*previous) : kept;
  std::vector<KeyValue> stale;
  for (const char* letter : {"m", "p"}) {
    auto ok = (*env)->for_each(letter, [&](std::string_view key, ByteView) {
      const std::string_view grid = key.substr(1, 8);
      if (grid != kept && grid != old) stale.push_back({std::string(key), {}, true});
      return true;
    });
    if (!ok) return ok;
  }
  if (auto ok = (*env)->write(stale); !ok) return ok;
  auto sources = names_under(**env, "s", 1);
  if (!sources) return sources.error();
  std::vector<std::string> missing;
  for (const std::string& name : *sources) {
    auto found = (*env)->read(info_key(kept, name), [](ByteView) {});
    if (!found) return found.error();
    if (!*found) missing.push_back(name);
  }
  return warp_missing(**env, layer, missing);
}

void verify_masks(const std::filesystem::path& data_dir, const LayerInfo& layer, VerifyReport& report) {
  const std::filesystem::path directory = layer_directory(data_dir, layer.name) / "masks";
  std::error_code ec;
  if (!std::filesystem::exists(directory / "data.mdb", ec)) return;
  auto env = shared_env(directory);
  if (!env) {
    report.problems.push_back(env.error().message);
    return;
  }
  std::map<std::string, std::int64_t> tiles_left;  // by grid and name: announced less found
  const auto ok = (*env)->for_each("", [&](std::string_view key_view, ByteView value) {
    const std::string key(key_view);
    ++report.values;
    report.bytes += static_cast<std::int64_t>(value.size());
    Result<void> good;
    std::string name = key.substr(1);
    if (key[0] == 's') {
      if (auto text = decode_text(value, key); !text) good = text.error();
    } else if (key.size() > 9) {
      const std::string grid = key.substr(1, 8);
      name = key.substr(9);
      if (key[0] == 'm') {
        auto record = record_from(value, key, name);
        if (record)
          tiles_left[grid + name] += record->tiles;
        else
          good = record.error();
      } else {
        name = name.substr(0, name.find('\0'));
        --tiles_left[grid + name];
        if (auto pixels = decode_pixels(value, key); !pixels) good = pixels.error();
      }
    }
    if (!good)
      report.problems.push_back((*env)->file().string() + ": mask " + name + ": " + good.error().message +
                                "; put it again");
    return true;
  });
  if (!ok) report.problems.push_back(ok.error().message);
  for (const auto& [mask, left] : tiles_left) {
    if (left != 0)
      report.problems.push_back((*env)->file().string() + ": mask " + mask.substr(8) + ": " +
                                std::to_string(left) + " tiles are missing; put it again");
  }
}

}  // namespace lodestone
