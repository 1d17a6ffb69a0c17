#include "storage/dem/tile_reader.h"

#include <algorithm>
#include <cstring>

namespace lodestone {
namespace {

std::size_t bytes_in(const HeightGrid& tile) {
  return sizeof(HeightGrid) + 96 + tile.heights_m.size() * 4 + tile.is_void.size();
}

void copy_part(const HeightGrid& from, HeightGrid& to) {
  const PostWindow part = intersection(from.window, to.window);
  if (part.is_empty()) return;
  const auto n = static_cast<std::size_t>(part.width());
  for (std::int64_t j = part.j0; j <= part.j1; ++j) {
    std::memcpy(&to.heights_m[to.index(part.i0, j)], &from.heights_m[from.index(part.i0, j)],
                n * sizeof(float));
  }
  if (from.is_void.empty()) return;
  if (to.is_void.empty()) to.is_void.assign(to.heights_m.size(), 0);
  for (std::int64_t j = part.j0; j <= part.j1; ++j) {
    std::memcpy(&to.is_void[to.index(part.i0, j)], &from.is_void[from.index(part.i0, j)], n);
  }
}

}  // namespace

PostWindow stored_window(const LayerInfo& layer, const TileId& id) {
  return intersection(layer.tile_window(id), layer.world_at(id.z));
}

Error TileReader::failed(Error error, const TileId& id) const {
  if (error.code == ErrorCode::kCorrupt) corrupt_values_.fetch_add(1, std::memory_order_relaxed);
  return Error{error.code, "layer " + layer_.name + ", tile " + to_string(id) + " in " +
                               env_->file().string() + ": " + error.message + "; ingest the layer again"};
}

Result<std::shared_ptr<const HeightGrid>> TileReader::tile(const TileId& id) const {
  Shard& shard = shards_[static_cast<std::size_t>(id.x * 5 + id.y * 3 + id.z) % kShards];
  {
    const std::lock_guard lock(shard.mutex);
    if (const auto found = shard.by_id.find(id); found != shard.by_id.end()) {
      shard.recent_first.splice(shard.recent_first.begin(), shard.recent_first, found->second);
      return found->second->second;
    }
  }
  const std::string key = tile_key(id);
  std::optional<Result<HeightGrid>> decoded;
  auto found =
      env_->read(key, [&](ByteView value) { decoded = decode_tile(value, key, stored_window(layer_, id)); });
  if (!found) return failed(std::move(found.error()), id);
  if (!*found) return failed(Error{ErrorCode::kCorrupt, "no such value stored"}, id);
  if (!*decoded) return failed(std::move(decoded->error()), id);
  auto tile = std::make_shared<const HeightGrid>(std::move(**decoded));

  const std::lock_guard lock(shard.mutex);
  if (shard.by_id.contains(id)) return tile;  // another thread was faster
  shard.recent_first.emplace_front(id, tile);
  shard.by_id[id] = shard.recent_first.begin();
  shard.bytes += bytes_in(*tile);
  while (shard.bytes > shard_bytes_ && shard.recent_first.size() > 1) {
    shard.bytes -= bytes_in(*shard.recent_first.back().second);
    shard.by_id.erase(shard.recent_first.back().first);
    shard.recent_first.pop_back();
  }
  return tile;
}

Result<VoidMode> TileReader::void_mode(const TileId& id) const {
  const std::string key = tile_key(id);
  std::optional<Result<VoidMode>> mode;
  auto found = env_->read(key, [&](ByteView value) { mode = tile_void_mode(value, key); });
  if (!found) return failed(std::move(found.error()), id);
  if (!*found) return failed(Error{ErrorCode::kCorrupt, "no such value stored"}, id);
  if (!*mode) return failed(std::move(mode->error()), id);
  return **mode;
}

Result<HeightGrid> TileReader::window(int level, const PostWindow& window) const {
  HeightGrid out;
  out.window = window;
  out.heights_m.resize(static_cast<std::size_t>(window.width() * window.height()));
  const std::int64_t n = layer_.cells_per_tile();
  const PostWindow tiles = layer_.tiles_at(level);
  // A tile's last column is also the next tile's first: it is taken from whichever the window needs anyway.
  const auto last = [n](std::int64_t lo, std::int64_t hi) { return (hi > lo ? hi - 1 : lo) / n; };
  const std::int64_t x0 = std::clamp(window.i0 / n, tiles.i0, tiles.i1);
  const std::int64_t x1 = std::clamp(last(window.i0, window.i1), tiles.i0, tiles.i1);
  const std::int64_t y0 = std::clamp(window.j0 / n, tiles.j0, tiles.j1);
  const std::int64_t y1 = std::clamp(last(window.j0, window.j1), tiles.j0, tiles.j1);
  for (std::int64_t y = y0; y <= y1; ++y) {
    for (std::int64_t x = x0; x <= x1; ++x) {
      auto part = tile({level, x, y});
      if (!part) return std::move(part.error());
      copy_part(**part, out);
    }
  }
  if (std::find(out.is_void.begin(), out.is_void.end(), std::uint8_t{1}) == out.is_void.end())
    out.is_void.clear();
  return out;
}

}  // namespace lodestone
