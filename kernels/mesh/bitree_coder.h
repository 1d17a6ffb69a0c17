#pragma once
// Geometry of a GTB stream: points of the Bitree level by level, in Sierpinski order, as chunk payloads.
// Source: Abasolo sec. 5: a state S, F or N per triangle, heights of selected points alone, a shared hypotenuse told once. The entropy
// coding (contexts from apexes and neighbours, heights predicted from the coarser lattice) is ours; docs/formats/gtb.md gives it.

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "kernels/mesh/bitree.h"
#include "kernels/mesh/bitree_range_coder.h"
#include "kernels/types/gtb_stream.h"
#include "kernels/types/result.h"

namespace lodestone {

// Common state of both directions. Use BitreeEncoder and BitreeDecoder.
class BitreeWalk {
 public:
  BitreeWalk(int n, std::span<const std::int32_t, 4> corner_q);

  // Level of the next triangle, 2n when nothing is left; triangles of that level without their chunk yet.
  int level() const { return level_; }
  std::size_t triangles_left() const { return frontier_.size() - cursor_; }

 protected:
  struct Node {
    std::int32_t p = 0;         // lattice height: q where selected, else the rounded mean of the hypotenuse's ends
    std::uint16_t residual = 0;   // |e| of a selected point, at most 65535: more makes no difference to a context
    std::uint8_t state = 0;     // kUnknown ..
  };
  enum : std::uint8_t { kUnknown = 0, kNone = 1, kSelected = 2, kFictitious = 3 };

  template <class Coder>
  bool code_chunk(Coder& coder, std::size_t count, const Bitree* source);
  template <class Coder>
  bool code_point(Coder& coder, int row, int col, int dir, const Bitree* source);
  void finish_level_if_done();
  std::int64_t mirrored(int row, int col) const;
  std::int64_t predict(int row, int col, int dir, int s, bool is_inner) const;

  int n_, width_, side_;
  int level_ = 0;
  std::size_t cursor_ = 0;
  std::vector<Node> nodes_;
  std::vector<RangeCell> cells_;
  std::vector<std::uint32_t> frontier_, next_;   // row << 17 | col << 3 | dir
  std::vector<std::uint32_t> fresh_;             // indices of nodes set in the chunk at hand
};

class BitreeEncoder : private BitreeWalk {
 public:
  // The tree must outlive the encoder.
  explicit BitreeEncoder(const Bitree& tree);
  using BitreeWalk::level;
  // The next chunk of this level; nothing when the level is done (or has no triangles).
  std::optional<GtbChunk> next(int level);

 private:
  const Bitree& tree_;
};

class BitreeDecoder : private BitreeWalk {
 public:
  // Needs a header with geometry, 1 <= n_geo <= 13, |corner_q| below kMaxLatticeHeight. Allocates 8 bytes per post.
  explicit BitreeDecoder(const GtbHeader& header);
  using BitreeWalk::level;
  using BitreeWalk::triangles_left;

  // Points of one chunk. Errors: kCorrupt for a chunk out of order, with more triangles than the level has left, or with heights beyond
  // the lattice; the tree is then as before the call, and no later chunk must be given.
  Result<void> accept(const GtbChunk& chunk);

  // What is known so far; valid after any number of chunks.
  Bitree tree() const;
  std::size_t selected() const { return selected_; }
  std::size_t fictitious() const { return fictitious_; }
  bool is_complete() const { return level() >= 2 * n_ || triangles_left() == 0; }

 private:
  double z_offset_m_, z_step_m_;
  std::size_t selected_ = 4, fictitious_ = 0;
};

// Header of a stream of this tree (geometry alone).
GtbHeader gtb_header_of(const Bitree& tree);

}  // namespace lodestone
