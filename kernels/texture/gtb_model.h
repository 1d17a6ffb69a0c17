#pragma once
// Front door of the Geometric-Textured Bitree: a terrain model as a progressive stream of chunks, and back from any prefix of it.
// Source: Abasolo sec. 5 and 6. The bytes are storage/formats/gtb.h's business.
//
//   encode:  GtbModelEncoder encoder(&tree, &texture);  while (auto chunk = encoder.next()) send(*chunk);
//   decode:  Result<GtbModelDecoder> decoder = GtbModelDecoder::open(header);  decoder->accept(chunk) for each;  decoder->tree() at any time.

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <vector>

#include "kernels/mesh/bitree.h"
#include "kernels/mesh/bitree_coder.h"
#include "kernels/texture/segmentation.h"
#include "kernels/texture/texture_coder.h"
#include "kernels/texture/texture_tree.h"
#include "kernels/types/gtb_stream.h"
#include "kernels/types/result.h"

namespace lodestone {

// A class map as triangles, with the patterns of its classes.
struct TextureModel {
  TextureTree tree;
  std::vector<RgbImage> patterns;   // per class of the map
};
// uniform_share: 1 keeps the class map exactly, 0.9 is the usual tolerance. Errors: kInvalidArgument outside (0, 1].
Result<TextureModel> texture_model_of(const TextureSegmentation& segmentation, double uniform_share = 0.9);

// Gives the chunks in the order of the stream, one by one: roots, then per level geometry and texture, then E. Each costs about a millisecond at most.
class GtbModelEncoder {
 public:
  // At least one of the two; both must outlive the encoder.
  GtbModelEncoder(const Bitree* tree, const TextureModel* texture);
  const GtbHeader& header() const { return header_; }
  std::optional<GtbChunk> next();   // E is the last; then nothing

 private:
  GtbHeader header_;
  const Bitree* tree_;
  std::optional<BitreeEncoder> geometry_;
  std::optional<TextureEncoder> texture_;
  int level_ = -1, levels_ = 0;
  bool is_texture_turn_ = true, has_ended_ = false;
};
GtbStream encode_gtb_model(const Bitree* tree, const TextureModel* texture);

// Takes chunks in the order of the stream; what it has is a valid model after any number of them.
class GtbModelDecoder {
 public:
  // Errors: kCorrupt for a header that breaks the format's ranges.
  static Result<GtbModelDecoder> open(const GtbHeader& header);

  // Errors: kCorrupt (order, counts, ranges). The chunk is then dropped, the model stays, later chunks are refused.
  Result<void> accept(const GtbChunk& chunk);

  const GtbHeader& header() const { return header_; }
  bool has_geometry() const { return geometry_.has_value(); }
  // Needs has_geometry(): its two roots are there from the header on.
  Bitree tree() const { return geometry_->tree(); }
  // Level that the geometry is in: bitree_error_bounds entry that holds for it.
  int geometry_level() const { return geometry_ ? geometry_->level() : 0; }
  // Texture: empty before its roots.
  std::vector<std::uint8_t> class_map() const { return texture_ ? texture_->class_map() : std::vector<std::uint8_t>(); }
  const std::vector<RgbImage>& patterns() const;
  std::size_t texture_triangles() const { return texture_ ? texture_->triangles() : 0; }
  bool is_complete() const { return has_ended_; }   // E came and agrees

 private:
  explicit GtbModelDecoder(const GtbHeader& header);
  Result<void> take(const GtbChunk& chunk);
  Result<void> check_end(const GtbChunk& chunk) const;

  GtbHeader header_;
  std::optional<BitreeDecoder> geometry_;
  std::optional<TextureDecoder> texture_;
  bool has_ended_ = false, has_failed_ = false;
};

}  // namespace lodestone
