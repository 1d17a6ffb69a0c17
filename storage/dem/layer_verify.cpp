// verify_layer: every value of a layer against its checksum, its shape and the list of tiles that must exist.

#include <map>
#include <optional>

#include "storage/dem/layer_files.h"
#include "storage/dem/mask_files.h"
#include "storage/dem/tile_codec.h"
#include "storage/dem/tile_reader.h"

namespace lodestone {

Result<VerifyReport> verify_layer(const std::filesystem::path& data_dir, const std::string& name,
                                  const std::function<void(double)>& progress) {
  VerifyReport report;
  auto generation = current_generation(data_dir, name);
  if (!generation) return generation.error();
  auto env = LmdbEnv::open(*generation, LmdbEnv::Mode::kFrozen);
  if (!env) {
    report.problems.push_back(env.error().message);
    return report;
  }
  auto info = read_layer_info(**env);
  if (!info) {
    report.problems.push_back(info.error().message);
    return report;
  }
  const auto problem = [&](const std::string& what, const std::string& why) {
    report.problems.push_back("layer " + name + ", " + what + " in " + (*env)->file().string() + ": " + why +
                              "; ingest the layer again");
  };

  // Every tile that must be there.
  double expected = 0;
  for (int z = 0; z <= info->base_level; ++z) {
    const PostWindow tiles = info->tiles_at(z);
    expected += static_cast<double>(tiles.width()) * static_cast<double>(tiles.height());
  }
  double seen = 0;
  for (int z = 0; z <= info->base_level; ++z) {
    const PostWindow tiles = info->tiles_at(z);
    for (std::int64_t y = tiles.j0; y <= tiles.j1; ++y) {
      for (std::int64_t x = tiles.i0; x <= tiles.i1; ++x) {
        const TileId id{z, x, y};
        const std::string key = tile_key(id);
        auto found = (*env)->read(key, [&](ByteView value) {
          ++report.values;
          report.bytes += static_cast<std::int64_t>(value.size());
          if (auto tile = decode_tile(value, key, stored_window(*info, id)); !tile)
            problem("tile " + to_string(id), tile.error().message);
        });
        if (!found)
          problem("tile " + to_string(id), found.error().message);
        else if (!*found)
          problem("tile " + to_string(id), "missing");
        seen += 1;
      }
      if (progress) progress(0.95 * seen / expected);
    }
  }
  for (const char* key : {kInfoKey, kRoughnessKey}) {
    auto found = (*env)->read(key, [&](ByteView value) {
      ++report.values;
      report.bytes += static_cast<std::int64_t>(value.size());
      if (auto text = decode_text(value, key); !text) problem(key, text.error().message);
    });
    if (!found)
      problem(key, found.error().message);
    else if (!*found)
      problem(key, "missing");
  }
  verify_masks(data_dir, *info, report);
  if (progress) progress(1);
  return report;
}

}  // namespace lodestone
