#pragma once
// Vertices along one edge of a tile, from the posts of that edge alone.

#include <cstdint>
#include <span>
#include <vector>

namespace lodestone {

// 1-D Douglas-Peucker from the first post: indices kept, ascending, both ends included. Every dropped post is
// at most tolerance_m (vertically) from the line between its kept neighbours; posts with is_void are not
// counted. Posts with is_required are kept (empty spans: none). Of equal errors the first post is split at.
std::vector<std::int32_t> simplify_edge(std::span<const float> heights_m,
                                        std::span<const std::uint8_t> is_required,
                                        std::span<const std::uint8_t> is_void, double tolerance_m);

}  // namespace lodestone
