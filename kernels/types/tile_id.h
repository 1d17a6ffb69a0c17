#pragma once
// TileId: the address of a tile in a layer's quadtree.

#include <compare>
#include <cstdint>
#include <string>

namespace lodestone {

// z: level, root = 0; x counts tiles eastwards, y southwards. Any value may be formed; a layer says which exist.
struct TileId {
  int z = 0;
  std::int64_t x = 0;
  std::int64_t y = 0;
  auto operator<=>(const TileId&) const = default;
};

// "z/x/y"
inline std::string to_string(const TileId& id) {
  return std::to_string(id.z) + "/" + std::to_string(id.x) + "/" + std::to_string(id.y);
}

}  // namespace lodestone
