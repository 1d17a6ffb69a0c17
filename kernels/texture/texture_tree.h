#pragma once
// The coloured Bitree: a class map as a hierarchy of right triangles with one class each. Source: Abasolo sec. 4.2.

#include <cstdint>
#include <span>
#include <vector>

namespace lodestone {

// Triangles of the bisected square of 2^n pixels a side are numbered as a heap in Sierpinski order: triangle k of level l has the
// children 2k and 2k + 1 of level l + 1; level l has 2^(l + 1) triangles, level 2n ends with half pixels.
struct TextureTree {
  int n = 0;
  int width = 0, height = 0;                            // pixels with weight
  std::vector<std::vector<std::uint8_t>> classes;       // [2n + 1][2^(l + 1)]: class of largest area, ties to the lowest id
  std::vector<std::vector<std::uint8_t>> is_uniform;    // its share reaches the tolerance, or nothing has weight, or level 2n
};

// The smallest n whose square holds the image.
int texture_tree_n(int width, int height);

// classes: width * height, row 0 north. uniform_share in (0, 1]: 1 keeps the map exactly. Triangles outside the image are uniform with
// their parent's class. Needs 1 to 8192 pixels a side.
TextureTree build_texture_tree(std::span<const std::uint8_t> classes, int width, int height, double uniform_share);

struct TextureTriangles {
  std::size_t visited = 0, leaves = 0;
};
TextureTriangles count_texture_triangles(const TextureTree& tree);

// Paints the pixels of triangle `index` of `level` that lie inside width * height. A pixel that a diagonal cuts takes the triangle of its
// northern half; so the leaves of any tree paint every pixel exactly once.
void paint_texture_triangle(int n, int level, std::uint32_t index, std::uint8_t value, std::span<std::uint8_t> pixels, int width, int height);

}  // namespace lodestone
