#pragma once
// Quadtree simplification of a square of heights: collapse the nodes that a bilinear patch describes best,
// then cut the leaves into triangles without cracks. Source: Hu & Wang figure 1 and section 3.2;
// SPEC-SYNTHESIS 5.7, 5.8.

#include <cstdint>
#include <span>
#include <vector>

#include "kernels/types/result.h"

namespace lodestone {

// A leaf: cells [x, x + size) x [y, y + size), size a power of two.
struct QuadtreeLeaf {
  int x = 0, y = 0, size = 1;
  bool operator==(const QuadtreeLeaf&) const = default;
};

struct QuadtreeMesh {
  std::vector<QuadtreeLeaf> leaves;  // Morton order
  std::vector<std::uint32_t>
      triangles;  // post indices j * posts + i, three each, counter-clockwise with y pointing north
  std::int64_t collapsed = 0;  // nodes whose four leaves became one
  double removed_percent = 0;  // 300 collapsed / cells
  double max_error_m = 0;      // largest error among the collapsed nodes
};

struct QuadtreeOptions {
  // Nodes with error <= max_error_m collapse when it is >= 0; else as many as meet `percent` of the cells.
  double max_error_m = -1;
  double percent = 0;  // 0..100
  // All posts on the square's border stay vertices, so squares side by side meet without cracks.
  bool keep_border = true;
};

// heights_m: posts * posts, row 0 north; posts = 2^k + 1, k 0..11.
// A node's error: max |h - bilinear of its corners| over its posts, and at least its children's. Nodes
// collapse in ascending (error, size, Morton index). Leaves with further vertices on an edge become fans
// around their centre post, the others two triangles by lowest_diagonal(). Errors: kInvalidArgument.
Result<QuadtreeMesh> simplify_quadtree(std::span<const float> heights_m, int posts,
                                       const QuadtreeOptions& options);

}  // namespace lodestone
