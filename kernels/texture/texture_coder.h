#pragma once
// Texture of a GTB stream: class tokens of the coloured Bitree level by level, and patterns, as chunk payloads.
// Source: Abasolo sec. 5: F = uniform, R = known texture, T = new texture, P = parent's, L = last one's. Entropy coding is ours.

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "kernels/mesh/bitree_range_coder.h"
#include "kernels/texture/texture_tree.h"
#include "kernels/types/gtb_stream.h"
#include "kernels/types/result.h"
#include "kernels/types/rgb_image.h"

namespace lodestone {

// Both directions. Classes are numbered by first use in the stream.
class TextureWalk {
 protected:
  struct Triangle {
    std::uint32_t index;   // TextureTree's
    std::uint8_t value;    // class
    std::uint8_t how;      // token that gave it
  };
  struct Leaf {
    std::uint32_t index;
    std::uint8_t level, value;
  };

  explicit TextureWalk(int n);
  template <class Coder>
  bool code_roots(Coder& coder, const TextureTree* tree);
  template <class Coder>
  bool code_chunk(Coder& coder, std::size_t count, const TextureTree* tree);
  template <class Coder>
  bool code_token(Coder& coder, int child, bool is_first_p, int parent, Triangle& child_triangle, int wanted);
  void finish_level_if_done();

  int n_;
  int level_ = -1;            // -1: the roots are next
  std::size_t cursor_ = 0;
  int last_ = -1;             // class of the last token
  int known_classes_ = 0;     // named by a token so far
  int allowed_classes_ = 0;   // whose pattern is there
  std::vector<RangeCell> cells_;
  std::vector<Triangle> frontier_, next_;
  std::vector<Leaf> leaves_;
};

class PatternCoder {
 public:
  PatternCoder();
  std::vector<std::uint8_t> encode(const RgbImage& pattern);
  // Errors: kCorrupt when a sample leaves 0..255.
  Result<RgbImage> decode(std::span<const std::uint8_t> payload, int side);

 private:
  template <class Coder>
  bool code(Coder& coder, int side, std::vector<std::int32_t>& planes);
  std::vector<RangeCell> cells_;
};

class TextureEncoder : private TextureWalk {
 public:
  // patterns: one per class of the tree, square, 1 to 255 pixels a side. They must outlive the encoder.
  TextureEncoder(const TextureTree& tree, std::span<const RgbImage> patterns);
  // Next chunk of the roots (level -1) or of a level; P chunks come before the T chunk that first names them. Nothing when done.
  std::optional<GtbChunk> next(int level);
  std::size_t classes() const { return static_cast<std::size_t>(known_classes_); }

 private:
  std::span<const RgbImage> patterns_;
  PatternCoder pattern_coder_;
  TextureTree numbered_;               // with the stream's class numbers
  std::vector<std::uint8_t> order_;    // the tree's class of each stream class
  std::vector<GtbChunk> waiting_;      // P chunks and their T chunk, last first
};

class TextureDecoder : private TextureWalk {
 public:
  // Needs a header with texture, as storage's reader lets pass.
  explicit TextureDecoder(const GtbHeader& header);
  // A P or T chunk. Errors: kCorrupt (order, counts, classes without a pattern); what was there before stays, no later chunk must be given.
  Result<void> accept(const GtbChunk& chunk);
  int level() const { return level_; }
  std::size_t triangles_left() const { return level_ < 0 ? 2 : frontier_.size() - cursor_; }
  std::size_t classes() const { return static_cast<std::size_t>(known_classes_); }
  bool is_complete() const { return level_ >= 2 * n_; }
  bool is_empty() const { return level_ < 0; }
  const std::vector<RgbImage>& patterns() const { return patterns_; }
  // Class per pixel as far as known, width * height; empty before the roots.
  std::vector<std::uint8_t> class_map() const;
  std::size_t triangles() const { return leaves_.size() + frontier_.size() - cursor_ + next_.size(); }

 private:
  int width_, height_;
  PatternCoder pattern_coder_;
  std::vector<RgbImage> patterns_;
};

}  // namespace lodestone
