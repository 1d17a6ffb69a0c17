#include "kernels/fractal/quadtree.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <string>

#include "kernels/fractal/level_of_detail.h"

namespace lodestone {
namespace {

std::uint32_t spread(std::uint32_t v) {
  v = (v | (v << 8)) & 0x00ff00ffu;
  v = (v | (v << 4)) & 0x0f0f0f0fu;
  v = (v | (v << 2)) & 0x33333333u;
  return (v | (v << 1)) & 0x55555555u;
}
std::uint32_t morton(int x, int y) {
  return spread(static_cast<std::uint32_t>(x)) | (spread(static_cast<std::uint32_t>(y)) << 1);
}

struct Node {
  float error_m;
  std::int32_t level;   // size 2^level
  std::uint32_t index;  // Morton index among the nodes of its level
};

class Simplifier {
 public:
  Simplifier(std::span<const float> heights, int posts)
      : heights_(heights),
        posts_(posts),
        cells_(posts - 1),
        depth_(std::countr_zero(static_cast<unsigned>(posts - 1))) {}

  QuadtreeMesh run(const QuadtreeOptions& options) {
    measure();
    choose(options);
    mark(depth_, 0, 0);
    mesh_.leaves.swap(leaves_);
    if (options.keep_border) keep_border();
    for (const QuadtreeLeaf& leaf : mesh_.leaves) cut(leaf);
    return std::move(mesh_);
  }

 private:
  std::size_t post(int x, int y) const {
    return static_cast<std::size_t>(y) * static_cast<std::size_t>(posts_) + static_cast<std::size_t>(x);
  }
  float h(int x, int y) const { return heights_[post(x, y)]; }

  // errors_[l][morton]: node of size 2^l, children's included, rounded up to float.
  void measure() {
    errors_.resize(static_cast<std::size_t>(depth_) + 1);
    for (int l = 1; l <= depth_; ++l) {
      const int size = 1 << l, nodes = cells_ >> l;
      std::vector<float>& errors = errors_[static_cast<std::size_t>(l)];
      errors.resize(static_cast<std::size_t>(nodes) * static_cast<std::size_t>(nodes));
      for (int b = 0; b < nodes; ++b) {
        for (int a = 0; a < nodes; ++a) {
          const std::uint32_t m = morton(a, b);
          float worst = own_error(a * size, b * size, size);
          if (l > 1)
            for (std::uint32_t k = 0; k < 4; ++k)
              worst = std::max(worst, errors_[static_cast<std::size_t>(l - 1)][4 * m + k]);
          errors[m] = worst;
        }
      }
    }
  }

  float own_error(int x, int y, int size) const {
    const double nw = h(x, y), ne = h(x + size, y), sw = h(x, y + size), se = h(x + size, y + size);
    const double step = 1.0 / size;
    double worst = 0;
    for (int j = 0; j <= size; ++j) {
      const double v = j * step, west = nw + v * (sw - nw), east = ne + v * (se - ne),
                   slope = (east - west) * step;
      const float* row = heights_.data() + post(x, y + j);
      double row_worst = 0;
      for (int i = 0; i <= size; ++i)
        row_worst = std::max(row_worst, std::abs(static_cast<double>(row[i]) - (west + slope * i)));
      worst = std::max(worst, row_worst);
    }
    float rounded = static_cast<float>(worst);
    if (static_cast<double>(rounded) < worst) rounded = std::nextafter(rounded, INFINITY);
    return rounded;
  }

  void choose(const QuadtreeOptions& options) {
    std::vector<Node> nodes;
    for (int l = 1; l <= depth_; ++l) {
      const std::vector<float>& errors = errors_[static_cast<std::size_t>(l)];
      for (std::uint32_t m = 0; m < errors.size(); ++m)
        if (options.max_error_m < 0 || static_cast<double>(errors[m]) <= options.max_error_m)
          nodes.push_back({errors[m], l, m});
    }
    const double cells = static_cast<double>(cells_) * cells_;
    if (options.max_error_m < 0) {
      const auto before = [](const Node& a, const Node& b) {
        return a.error_m != b.error_m ? a.error_m < b.error_m
               : a.level != b.level   ? a.level < b.level
                                      : a.index < b.index;
      };
      const auto wanted = static_cast<std::size_t>(std::floor(cells * options.percent / 300 + 0.5));
      const std::size_t count = std::min(wanted, nodes.size());
      std::nth_element(nodes.begin(), nodes.begin() + static_cast<std::ptrdiff_t>(count), nodes.end(),
                       before);
      nodes.resize(count);
    }
    is_collapsed_.resize(errors_.size());
    for (std::size_t l = 1; l < errors_.size(); ++l) is_collapsed_[l].assign(errors_[l].size(), 0);
    for (const Node& node : nodes) {
      is_collapsed_[static_cast<std::size_t>(node.level)][node.index] = 1;
      mesh_.max_error_m = std::max(mesh_.max_error_m, static_cast<double>(node.error_m));
    }
    mesh_.collapsed = static_cast<std::int64_t>(nodes.size());
    mesh_.removed_percent = 300 * static_cast<double>(nodes.size()) / cells;
  }

  // Leaves and the posts that are their corners.
  void mark(int l, int a, int b) {
    if (is_vertex_.empty()) is_vertex_.assign(heights_.size(), 0);
    if (l > 0 && is_collapsed_[static_cast<std::size_t>(l)][morton(a, b)] == 0) {
      for (int k = 0; k < 4; ++k) mark(l - 1, 2 * a + (k & 1), 2 * b + (k >> 1));
      return;
    }
    const int size = 1 << l, x = a << l, y = b << l;
    leaves_.push_back({x, y, size});
    for (int k = 0; k < 4; ++k) is_vertex_[post(x + (k & 1) * size, y + (k >> 1) * size)] = 1;
  }

  void keep_border() {
    for (int n = 0; n < posts_; ++n)
      for (const std::size_t p : {post(n, 0), post(n, cells_), post(0, n), post(cells_, n)})
        is_vertex_[p] = 1;
  }

  void triangle(std::size_t a, std::size_t b, std::size_t c) {
    for (const std::size_t v : {a, b, c}) mesh_.triangles.push_back(static_cast<std::uint32_t>(v));
  }

  void cut(const QuadtreeLeaf& leaf) {
    const int x = leaf.x, y = leaf.y, s = leaf.size;
    ring_.clear();  // counter-clockwise from the north-west corner
    const auto side = [&](int px, int py, int dx, int dy) {
      for (int n = 0; n < s; ++n)
        if (is_vertex_[post(px + n * dx, py + n * dy)]) ring_.push_back(post(px + n * dx, py + n * dy));
    };
    side(x, y, 0, 1);
    side(x, y + s, 1, 0);
    side(x + s, y + s, 0, -1);
    side(x + s, y, -1, 0);
    if (ring_.size() > 4) {
      const std::size_t centre = post(x + s / 2, y + s / 2);
      for (std::size_t n = 0; n < ring_.size(); ++n)
        triangle(centre, ring_[n], ring_[(n + 1) % ring_.size()]);
      return;
    }
    const std::size_t nw = ring_[0], sw = ring_[1], se = ring_[2], ne = ring_[3];
    if (lowest_diagonal(heights_[nw], heights_[ne], heights_[sw], heights_[se]) ==
        Diagonal::kNorthWestSouthEast) {
      triangle(nw, sw, se);
      triangle(nw, se, ne);
    } else {
      triangle(nw, sw, ne);
      triangle(sw, se, ne);
    }
  }

  const std::span<const float> heights_;
  const int posts_, cells_, depth_;
  std::vector<std::vector<float>> errors_;
  std::vector<std::vector<std::uint8_t>> is_collapsed_;
  std::vector<std::uint8_t> is_vertex_;
  std::vector<QuadtreeLeaf> leaves_;
  std::vector<std::size_t> ring_;
  QuadtreeMesh mesh_;
};

}  // namespace

Result<QuadtreeMesh> simplify_quadtree(std::span<const float> heights_m, int posts,
                                       const QuadtreeOptions& options) {
  if (posts < 2 || posts > 2049 || !std::has_single_bit(static_cast<unsigned>(posts - 1)))
    return Error{ErrorCode::kInvalidArgument,
                 "quadtree: posts must be 2^k + 1, 2..2049, found " + std::to_string(posts)};
  if (heights_m.size() != static_cast<std::size_t>(posts) * static_cast<std::size_t>(posts))
    return Error{ErrorCode::kInvalidArgument, "quadtree: " + std::to_string(posts) + " x " +
                                                  std::to_string(posts) + " heights expected, found " +
                                                  std::to_string(heights_m.size())};
  if (!(options.percent >= 0 && options.percent <= 100) || std::isnan(options.max_error_m))
    return Error{ErrorCode::kInvalidArgument,
                 "quadtree: percent must be 0..100, found " + std::to_string(options.percent)};
  if (!std::all_of(heights_m.begin(), heights_m.end(), [](float h) { return std::isfinite(h); }))
    return Error{ErrorCode::kInvalidArgument, "quadtree: heights must be finite; fill voids first"};
  return Simplifier(heights_m, posts).run(options);
}

}  // namespace lodestone
