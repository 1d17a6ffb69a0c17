#include "kernels/mesh/bitree_coder.h"

#include <algorithm>
#include <array>
#include <cassert>
#include <cstdlib>
#include <string>

#include "kernels/mesh/bitree_lattice.h"

namespace lodestone {

namespace {

// Where the context groups begin.
constexpr std::size_t kNoneCells = 0, kFictitiousCells = 864, kZeroCells = 1728, kSignCells = 1760, kSizeCells = 1762;
constexpr std::size_t kAllCells = kSizeCells + 16 * kUintCells;

std::uint32_t packed(int row, int col, int dir) {
  return static_cast<std::uint32_t>(row) << 17 | static_cast<std::uint32_t>(col) << 3 | static_cast<std::uint32_t>(dir);
}

}  // namespace

BitreeWalk::BitreeWalk(int n, std::span<const std::int32_t, 4> corner_q)
    : n_(n), width_(1 << n), side_(width_ + 1), nodes_(static_cast<std::size_t>(side_) * static_cast<std::size_t>(side_)), cells_(kAllCells) {
  assert(n >= 1 && n <= kMaxBitreeN && "a Bitree has 1 to 13 doublings");
  for (int corner = 0; corner < 4; ++corner) {
    const std::size_t at = static_cast<std::size_t>(corner / 2 * width_) * static_cast<std::size_t>(side_) + static_cast<std::size_t>(corner % 2 * width_);
    nodes_[at] = {corner_q[static_cast<std::size_t>(corner)], 0, kSelected};
  }
  for (const int dir : kRootDir) frontier_.push_back(packed(width_ / 2, width_ / 2, dir));
}

// Lattice height with odd reflection at the tile's edges.
std::int64_t BitreeWalk::mirrored(int row, int col) const {
  if (row < 0) return 2 * mirrored(0, col) - mirrored(-row, col);
  if (row > width_) return 2 * mirrored(width_, col) - mirrored(2 * width_ - row, col);
  if (col < 0) return 2 * mirrored(row, 0) - mirrored(row, -col);
  if (col > width_) return 2 * mirrored(row, width_) - mirrored(row, 2 * width_ - col);
  return nodes_[static_cast<std::size_t>(row) * static_cast<std::size_t>(side_) + static_cast<std::size_t>(col)].p;
}

// Interpolation from the finished levels: 4 x 4 cubic for square centres, along the edge and across it for edge midpoints.
std::int64_t BitreeWalk::predict(int row, int col, int dir, int s, bool is_inner) const {
  const auto cubic = [](std::int64_t far_a, std::int64_t a, std::int64_t b, std::int64_t far_b) { return 9 * (a + b) - far_a - far_b; };
  const std::ptrdiff_t at = static_cast<std::ptrdiff_t>(row) * side_ + col;
  if (level_ % 2 == 0) {
    if (2 * s == width_) {
      std::int64_t sum = 2;
      for (const int r : {-s, s}) sum += mirrored(row + r, col - s) + mirrored(row + r, col + s);
      return sum >> 2;
    }
    std::array<std::int64_t, 4> line{};
    for (int i = 0; i < 4; ++i) {
      const int dr = (2 * i - 3) * s;
      if (is_inner) {
        const Node* const base = nodes_.data() + at + static_cast<std::ptrdiff_t>(dr) * side_;
        line[static_cast<std::size_t>(i)] = cubic(base[-3 * s].p, base[-s].p, base[s].p, base[3 * s].p);
      } else {
        line[static_cast<std::size_t>(i)] = cubic(mirrored(row + dr, col - 3 * s), mirrored(row + dr, col - s), mirrored(row + dr, col + s), mirrored(row + dr, col + 3 * s));
      }
    }
    return (cubic(line[0], line[1], line[2], line[3]) + 128) >> 8;
  }
  // The apex lies across the edge; the edge runs a quarter turn from it.
  const int across_r = kDirRow[dir] * s, across_c = kDirCol[dir] * s, along_r = across_c, along_c = across_r;
  const bool is_tile_edge = row == 0 || col == 0 || row == width_ || col == width_;
  const auto height = [&](int dr, int dc) -> std::int64_t {
    return is_inner ? nodes_[static_cast<std::size_t>(at + static_cast<std::ptrdiff_t>(dr) * side_ + dc)].p : mirrored(row + dr, col + dc);
  };
  const std::int64_t a = height(-along_r, -along_c), b = height(along_r, along_c);
  if (2 * s == width_) {
    if (is_tile_edge) return (a + b + 1) >> 1;
    return (a + b + height(-across_r, -across_c) + height(across_r, across_c) + 2) >> 2;
  }
  const std::int64_t along = cubic(height(-3 * along_r, -3 * along_c), a, b, height(3 * along_r, 3 * along_c));
  if (is_tile_edge) return (along + 8) >> 4;
  return (3 * along + 8 * (height(-across_r, -across_c) + height(across_r, across_c)) + 32) >> 6;
}

// State and height of one split point; false when the height leaves the lattice.
template <class Coder>
bool BitreeWalk::code_point(Coder& coder, int row, int col, int dir, const Bitree* source) {
  const int s = half_side(n_, level_);
  const std::ptrdiff_t at = static_cast<std::ptrdiff_t>(row) * side_ + col;
  Node& node = nodes_[static_cast<std::size_t>(at)];
  fresh_.push_back(static_cast<std::uint32_t>(at));

  // Apexes: both must be in the mesh, or the triangle across does not exist and the point cannot be.
  const int dr = kDirRow[dir] * s, dc = kDirCol[dir] * s;
  const std::ptrdiff_t across = static_cast<std::ptrdiff_t>(dr) * side_ + dc;
  const Node& own = nodes_[static_cast<std::size_t>(at + across)];
  int fictitious_apexes = own.state == kFictitious ? 1 : 0;
  std::uint32_t acc = own.state == kSelected ? own.residual : 0, weight = own.state == kSelected ? 1 : 0;
  const bool has_other = row - dr >= 0 && row - dr <= width_ && col - dc >= 0 && col - dc <= width_;
  if (has_other) {
    const Node& other = nodes_[static_cast<std::size_t>(at - across)];
    if (other.state < kSelected) {
      node.state = kNone;
      return true;
    }
    if (other.state == kSelected) {
      acc += other.residual;
      ++weight;
    } else {
      ++fictitious_apexes;
    }
  }
  const int apex_kind = has_other ? fictitious_apexes : 2 * fictitious_apexes;

  // The four neighbours of the same level, as far as they are known.
  const bool is_inner = row >= 3 * s && row + 3 * s <= width_ && col >= 3 * s && col + 3 * s <= width_;
  int none = 0, active = 0;
  const auto look = [&](const Node& neighbour) {
    none += neighbour.state == kNone ? 1 : 0;
    active += neighbour.state >= kSelected ? 1 : 0;
    const std::uint32_t is_selected = neighbour.state == kSelected ? 2 : 0;
    acc += is_selected * neighbour.residual;
    weight += is_selected;
  };
  const bool is_even = level_ % 2 == 0;
  const std::array<std::array<int, 2>, 4> offsets = is_even ? std::array<std::array<int, 2>, 4>{{{-2 * s, 0}, {2 * s, 0}, {0, -2 * s}, {0, 2 * s}}}
                                                           : std::array<std::array<int, 2>, 4>{{{-s, -s}, {-s, s}, {s, -s}, {s, s}}};
  for (const auto& [r, c] : offsets) {
    if (is_inner || (row + r >= 0 && row + r <= width_ && col + c >= 0 && col + c <= width_)) {
      look(nodes_[static_cast<std::size_t>(at + static_cast<std::ptrdiff_t>(r) * side_ + c)]);
    }
  }
  const auto context = static_cast<std::size_t>(27 * level_ + 9 * apex_kind + 3 * std::min(none, 2) + std::min(active, 2));

  BitreeState wanted = BitreeState::kNone;
  if constexpr (!Coder::kReads) wanted = source->state[static_cast<std::size_t>(at)];
  if (coder.bit(cells_[kNoneCells + context], wanted == BitreeState::kNone)) {
    node.state = kNone;
    return true;
  }
  if (coder.bit(cells_[kFictitiousCells + context], wanted == BitreeState::kFictitious)) {
    node.state = kFictitious;
    return true;
  }

  // Residual against the prediction.
  const std::int64_t predicted = predict(row, col, dir, s, is_inner);
  std::int64_t e = 0;
  if constexpr (!Coder::kReads) e = source->q[static_cast<std::size_t>(at)] - predicted;
  const std::uint32_t bin = weight == 0 ? 15 : std::min(14, static_cast<int>(std::bit_width(4 * acc / weight)));
  const std::uint32_t parity = static_cast<std::uint32_t>(level_ % 2);
  if (coder.bit(cells_[kZeroCells + 2 * bin + parity], e == 0)) {
    e = 0;
  } else {
    const bool is_negative = coder.bit(cells_[kSignCells + parity], e < 0);
    const std::int64_t size = static_cast<std::int64_t>(code_uint(coder, &cells_[kSizeCells + kUintCells * bin], static_cast<std::uint32_t>(std::abs(e) - 1))) + 1;
    e = is_negative ? -size : size;
  }
  const std::int64_t q = predicted + e;
  if (q <= -kMaxLatticeHeight || q >= kMaxLatticeHeight) return false;
  node.p = static_cast<std::int32_t>(q);
  node.residual = static_cast<std::uint16_t>(std::min<std::int64_t>(std::abs(e), 65535));
  node.state = kSelected;
  return true;
}

template <class Coder>
bool BitreeWalk::code_chunk(Coder& coder, std::size_t count, const Bitree* source) {
  fresh_.clear();
  const bool has_next = level_ + 1 < 2 * n_;
  const int child_s = has_next ? half_side(n_, level_ + 1) : 0;
  for (const std::size_t stop = cursor_ + count; cursor_ < stop; ++cursor_) {
    const std::uint32_t triangle = frontier_[cursor_];
    const int row = static_cast<int>(triangle >> 17), col = static_cast<int>(triangle >> 3 & 0x3fff), dir = static_cast<int>(triangle & 7);
    const Node& node = nodes_[static_cast<std::size_t>(row) * static_cast<std::size_t>(side_) + static_cast<std::size_t>(col)];
    if (node.state == kUnknown && !code_point(coder, row, col, dir, source)) return false;
    if (node.state < kSelected || !has_next) continue;
    // The split point is the children's apex.
    for (const int child : {first_child_dir(dir, level_), second_child_dir(dir, level_)}) {
      next_.push_back(packed(row - kDirRow[child] * child_s, col - kDirCol[child] * child_s, child));
    }
  }
  return true;
}

void BitreeWalk::finish_level_if_done() {
  while (level_ < 2 * n_ && cursor_ == frontier_.size()) {
    if (!next_.empty()) {
      // Everything that is not selected gets its place on the lattice, for the predictions of the next levels.
      for_each_split_point(n_, level_, [&](const SplitPoint& p) {
        Node& node = nodes_[static_cast<std::size_t>(p.index)];
        if (node.state == kSelected) return;
        node.p = (nodes_[static_cast<std::size_t>(p.end_a)].p + nodes_[static_cast<std::size_t>(p.end_b)].p + 1) >> 1;
      });
    }
    frontier_.swap(next_);
    next_.clear();
    cursor_ = 0;
    ++level_;
    if (frontier_.empty()) level_ = 2 * n_;
  }
}

BitreeEncoder::BitreeEncoder(const Bitree& tree)
    : BitreeWalk(tree.n, std::array<std::int32_t, 4>(gtb_header_of(tree).corner_q)), tree_(tree) {}

std::optional<GtbChunk> BitreeEncoder::next(int level) {
  if (level != level_ || triangles_left() == 0) return std::nullopt;
  const std::size_t count = std::min<std::size_t>(triangles_left(), kGtbChunkTriangles);
  RangeEncoder coder;
  const bool is_coded = code_chunk(coder, count, &tree_);
  assert(is_coded && "a Bitree holds lattice heights below 2^26");
  static_cast<void>(is_coded);
  finish_level_if_done();
  return GtbChunk{GtbChunkType::kGeometry, static_cast<std::uint8_t>(level), static_cast<std::uint32_t>(count), coder.finish()};
}

BitreeDecoder::BitreeDecoder(const GtbHeader& header)
    : BitreeWalk(header.n_geo, header.corner_q), z_offset_m_(header.z_offset_m), z_step_m_(header.z_step_m) {}

Result<void> BitreeDecoder::accept(const GtbChunk& chunk) {
  if (chunk.type != GtbChunkType::kGeometry || chunk.level != level_ || level_ >= 2 * n_) {
    return Error{ErrorCode::kCorrupt, "GTB stream: geometry of level " + std::to_string(level_) + " expected, level " + std::to_string(chunk.level) + " found"};
  }
  if (chunk.count == 0 || chunk.count > kGtbChunkTriangles || chunk.count > triangles_left()) {
    return Error{ErrorCode::kCorrupt, "GTB stream: 1 to " + std::to_string(std::min<std::size_t>(triangles_left(), kGtbChunkTriangles)) +
                                          " triangles expected in a chunk of level " + std::to_string(level_) + ", " + std::to_string(chunk.count) + " found"};
  }
  RangeDecoder coder(chunk.payload);
  if (!code_chunk(coder, chunk.count, nullptr)) {
    for (const std::uint32_t at : fresh_) nodes_[at] = {};
    return Error{ErrorCode::kCorrupt, "GTB stream: a height of level " + std::to_string(level_) + " is 2^26 steps or more from the offset"};
  }
  for (const std::uint32_t at : fresh_) {
    selected_ += nodes_[at].state == kSelected ? 1 : 0;
    fictitious_ += nodes_[at].state == kFictitious ? 1 : 0;
  }
  finish_level_if_done();
  return {};
}

Bitree BitreeDecoder::tree() const {
  Bitree tree;
  tree.n = n_;
  tree.z_offset_m = z_offset_m_;
  tree.z_step_m = z_step_m_;
  tree.selected = selected_;
  tree.fictitious = fictitious_;
  tree.state.resize(nodes_.size());
  tree.q.resize(nodes_.size());
  for (std::size_t at = 0; at < nodes_.size(); ++at) {
    const Node& node = nodes_[at];
    tree.state[at] = node.state == kSelected ? BitreeState::kSelected : node.state == kFictitious ? BitreeState::kFictitious : BitreeState::kNone;
    tree.q[at] = node.state == kSelected ? node.p : 0;
  }
  return tree;
}

GtbHeader gtb_header_of(const Bitree& tree) {
  GtbHeader header;
  header.has_geometry = true;
  header.n_geo = static_cast<std::uint8_t>(tree.n);
  header.z_offset_m = tree.z_offset_m;
  header.z_step_m = tree.z_step_m;
  const int width = 1 << tree.n;
  for (int corner = 0; corner < 4; ++corner) header.corner_q[static_cast<std::size_t>(corner)] = tree.q[tree.index(corner / 2 * width, corner % 2 * width)];
  return header;
}

}  // namespace lodestone
