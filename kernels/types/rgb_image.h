#pragma once
// RgbImage: 8-bit colour pixels, row 0 north.

#include <cstddef>
#include <cstdint>
#include <vector>

namespace lodestone {

struct RgbImage {
  int width = 0, height = 0;
  std::vector<std::uint8_t> rgb;   // 3 * width * height, red first

  std::size_t index(int row, int col) const { return 3 * (static_cast<std::size_t>(row) * static_cast<std::size_t>(width) + static_cast<std::size_t>(col)); }
  bool operator==(const RgbImage&) const = default;
};

}  // namespace lodestone
