#include <algorithm>
#include <array>
#include <cassert>

#include "kernels/mesh/bitree.h"
#include "kernels/mesh/bitree_lattice.h"

namespace lodestone {

namespace {

struct Corner {
  std::int32_t row, col;
};
struct Triangle {
  Corner apex, p, q;
  std::int32_t level;
};
Corner middle(Corner a, Corner b) { return {(a.row + b.row) / 2, (a.col + b.col) / 2}; }

// Hands out vertex numbers in order of first use; heights of fictitious points are means down from selected ones.
class VertexTable {
 public:
  VertexTable(const Bitree& tree, TinMesh& mesh) : tree_(tree), mesh_(mesh), number_(tree.state.size(), kUnused), heights_m_(bitree_surface(tree)) {}

  std::uint32_t of(Corner c) {
    const std::size_t at = tree_.index(c.row, c.col);
    if (number_[at] == kUnused) {
      number_[at] = static_cast<std::uint32_t>(mesh_.vertices.size());
      mesh_.vertices.push_back({c.col, c.row, static_cast<float>(heights_m_[at])});
    }
    return number_[at];
  }

 private:
  static constexpr std::uint32_t kUnused = 0xffffffff;
  const Bitree& tree_;
  TinMesh& mesh_;
  std::vector<std::uint32_t> number_;
  std::vector<double> heights_m_;
};

}  // namespace

TinMesh bitree_mesh(const Bitree& tree, std::int64_t i0, std::int64_t j0) {
  TinMesh mesh;
  const int width = 1 << tree.n;
  mesh.cols = mesh.rows = width + 1;
  mesh.i0 = i0;
  mesh.j0 = j0;
  mesh.vertices.reserve(tree.selected + tree.fictitious);
  mesh.triangles.reserve(6 * (tree.selected + tree.fictitious));
  VertexTable vertices(tree, mesh);

  std::vector<Triangle> stack;
  const Corner nw{0, 0}, ne{0, width}, sw{width, 0}, se{width, width};
  stack.push_back({sw, se, nw, 0});
  stack.push_back({ne, nw, se, 0});
  while (!stack.empty()) {
    const Triangle t = stack.back();
    stack.pop_back();
    if (t.level < 2 * tree.n) {
      const Corner m = middle(t.p, t.q);
      if (tree.state[tree.index(m.row, m.col)] != BitreeState::kNone) {
        const Triangle first{m, t.apex, t.p, t.level + 1}, second{m, t.q, t.apex, t.level + 1};
        const bool is_even = t.level % 2 == 0;   // Sierpinski order
        stack.push_back(is_even ? second : first);
        stack.push_back(is_even ? first : second);
        continue;
      }
    }
    for (const Corner c : {t.apex, t.p, t.q}) mesh.triangles.push_back(vertices.of(c));
  }
  mesh.top_vertices = mesh.vertices.size();
  mesh.top_triangles = mesh.triangle_count();
  return mesh;
}

std::vector<std::uint32_t> bitree_strip(const TinMesh& mesh) {
  using Leaf = std::array<std::uint32_t, 3>;
  const auto leaf = [&](std::size_t t) { return Leaf{mesh.triangles[3 * t], mesh.triangles[3 * t + 1], mesh.triangles[3 * t + 2]}; };
  const auto has = [](const Leaf& l, std::uint32_t v) { return l[0] == v || l[1] == v || l[2] == v; };
  std::vector<std::uint32_t> strip;
  const std::size_t count = mesh.top_triangles;
  if (count == 0) return strip;
  strip.reserve(2 + 2 * count);

  // The first leaf begins with the vertex that the second one lacks.
  Leaf first = leaf(0);
  while (count > 1 && has(leaf(1), first[0])) std::rotate(first.begin(), first.begin() + 1, first.end());
  strip = {first[0], first[1]};
  std::uint32_t x = first[0], y = first[1];   // the edge that the strip ends with
  for (std::size_t t = 0; t < count; ++t) {
    const Leaf now = leaf(t);
    std::uint32_t v = now[0];
    for (const std::uint32_t corner : now) {
      if (corner != x && corner != y) v = corner;
    }
    const bool turns = t + 1 < count && has(leaf(t + 1), x);   // the next leaf lies on (x, v), not on (y, v)
    if (turns) {
      strip.push_back(x);
      strip.push_back(v);
    } else {
      strip.push_back(v);
      x = y;
    }
    y = v;
  }
  return strip;
}

Result<TinMesh> build_bitree_mesh(const BitreeRequest& request, std::int64_t i0, std::int64_t j0, bool is_quadtree) {
  Result<Bitree> tree = build_bitree(request);
  if (!tree) return std::move(tree.error());
  if (is_quadtree) {
    if (Result<void> ok = promote_fictitious(*tree, request.field); !ok) return std::move(ok.error());
  }
  TinMesh mesh = bitree_mesh(*tree, i0, j0);
  const BitreeError error = measure_bitree_error(*tree, request.field);
  mesh.max_error_m = error.max_m;
  mesh.rms_error_m = error.rms_m;
  return mesh;
}

}  // namespace lodestone
