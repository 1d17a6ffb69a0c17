#pragma once
// The bytes of one stored tile (storage/FORMAT.md, "Tile value") and of a checked text.

#include <cstdint>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "kernels/types/height_grid.h"
#include "kernels/types/result.h"
#include "kernels/types/tile_id.h"

namespace lodestone {

enum class VoidMode : std::uint8_t { kNone = 0, kAll = 1, kSome = 2 };  // on disk: never renumber

// Key of tile `id`: 't', z, y and x as big-endian 32-bit numbers, so that rows of a level are neighbours.
std::string tile_key(const TileId& id);

// Heights (any bit pattern, finite) and flags of a tile, checked by XXH3-64 seeded with the key.
// Deterministic.
std::vector<std::uint8_t> encode_tile(const HeightGrid& tile, std::string_view key);
// `window` says where the tile lies and so its shape. Error: kCorrupt (what was expected and found; without
// file or tile name).
Result<HeightGrid> decode_tile(std::span<const std::uint8_t> value, std::string_view key,
                               const PostWindow& window);
// The void mode alone: reads the header, which has its own check.
Result<VoidMode> tile_void_mode(std::span<const std::uint8_t> value, std::string_view key);

// "LSTX", four zero bytes, XXH3-64 seeded with the key, text.
std::vector<std::uint8_t> encode_text(std::string_view text, std::string_view key);
Result<std::string> decode_text(std::span<const std::uint8_t> value, std::string_view key);

}  // namespace lodestone
