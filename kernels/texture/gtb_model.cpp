#include "kernels/texture/gtb_model.h"

#include <algorithm>
#include <array>
#include <cassert>
#include <cmath>
#include <cstdlib>
#include <string>

namespace lodestone {

namespace {

Error corrupt(std::string message) { return {ErrorCode::kCorrupt, "GTB stream: " + std::move(message)}; }

GtbChunk end_chunk(std::size_t selected, std::size_t fictitious, std::size_t classes) {
  GtbChunk chunk;
  for (const std::size_t value : {selected, fictitious, classes}) {
    for (int byte = 0; byte < 4; ++byte) chunk.payload.push_back(static_cast<std::uint8_t>(value >> 8 * byte));
  }
  return chunk;
}

}  // namespace

Result<TextureModel> texture_model_of(const TextureSegmentation& segmentation, double uniform_share) {
  if (!(uniform_share > 0 && uniform_share <= 1)) return Error{ErrorCode::kInvalidArgument, "texture: uniform_share must be above 0 and at most 1"};
  return TextureModel{build_texture_tree(segmentation.classes, segmentation.width, segmentation.height, uniform_share), segmentation.patterns};
}

GtbModelEncoder::GtbModelEncoder(const Bitree* tree, const TextureModel* texture) : tree_(tree) {
  assert((tree != nullptr || texture != nullptr) && "a stream holds geometry, texture, or both");
  if (tree != nullptr) {
    header_ = gtb_header_of(*tree);
    geometry_.emplace(*tree);
    levels_ = 2 * tree->n;
  }
  if (texture != nullptr) {
    header_.has_texture = true;
    header_.n_tex = static_cast<std::uint8_t>(texture->tree.n);
    header_.texture_width = static_cast<std::uint16_t>(texture->tree.width);
    header_.texture_height = static_cast<std::uint16_t>(texture->tree.height);
    for (const RgbImage& pattern : texture->patterns) header_.pattern_side = std::max(header_.pattern_side, static_cast<std::uint8_t>(pattern.width));
    texture_.emplace(texture->tree, texture->patterns);
    levels_ = std::max(levels_, 2 * texture->tree.n);
  }
}

std::optional<GtbChunk> GtbModelEncoder::next() {
  while (level_ < levels_) {
    if (!is_texture_turn_) {
      if (geometry_) {
        if (std::optional<GtbChunk> chunk = geometry_->next(level_)) return chunk;
      }
      is_texture_turn_ = true;
    }
    if (texture_) {
      if (std::optional<GtbChunk> chunk = texture_->next(level_)) return chunk;
    }
    ++level_;
    is_texture_turn_ = false;
  }
  if (has_ended_) return std::nullopt;
  has_ended_ = true;
  return end_chunk(tree_ != nullptr ? tree_->selected : 0, tree_ != nullptr ? tree_->fictitious : 0, texture_ ? texture_->classes() : 0);
}

GtbStream encode_gtb_model(const Bitree* tree, const TextureModel* texture) {
  GtbModelEncoder encoder(tree, texture);
  GtbStream stream{encoder.header(), {}};
  while (std::optional<GtbChunk> chunk = encoder.next()) stream.chunks.push_back(std::move(*chunk));
  return stream;
}

GtbModelDecoder::GtbModelDecoder(const GtbHeader& header) : header_(header) {
  if (header.has_geometry) geometry_.emplace(header);
  if (header.has_texture) texture_.emplace(header);
}

Result<GtbModelDecoder> GtbModelDecoder::open(const GtbHeader& header) {
  if (!header.has_geometry && !header.has_texture) return corrupt("neither geometry nor texture in the header");
  if (header.has_geometry) {
    const bool is_lattice = std::all_of(header.corner_q.begin(), header.corner_q.end(), [](std::int32_t q) { return q > -kMaxLatticeHeight && q < kMaxLatticeHeight; });
    if (header.n_geo < 1 || header.n_geo > kMaxBitreeN || header.predictor != 2 || !is_lattice || !(header.z_step_m > 0) || !std::isfinite(header.z_step_m) || !std::isfinite(header.z_offset_m)) {
      return corrupt("the header's geometry is out of range");
    }
  }
  if (header.has_texture && (header.n_tex > kMaxBitreeN || header.texture_width == 0 || header.texture_height == 0 ||
                             std::max(header.texture_width, header.texture_height) > 1U << header.n_tex)) {
    return corrupt("the header's texture size is out of range");
  }
  return GtbModelDecoder(header);
}

Result<void> GtbModelDecoder::accept(const GtbChunk& chunk) {
  if (has_failed_ || has_ended_) return corrupt(has_ended_ ? "nothing follows chunk E" : "decoding stopped at an earlier chunk");
  Result<void> taken = take(chunk);
  has_failed_ = !taken;
  return taken;
}

Result<void> GtbModelDecoder::take(const GtbChunk& chunk) {
  // Levels of the two halves keep step: the roots of the texture first, then level by level geometry before texture.
  const auto level_of_texture = [&] { return texture_ && !texture_->is_complete() ? texture_->level() : 1 << 8; };
  const auto level_of_geometry = [&] { return geometry_ && !geometry_->is_complete() ? geometry_->level() : 1 << 8; };
  switch (chunk.type) {
    case GtbChunkType::kGeometry:
      if (!geometry_) return corrupt("geometry in a stream without it");
      if (level_of_texture() < level_of_geometry()) return corrupt("texture of level " + std::to_string(level_of_texture()) + " expected, geometry found");
      return geometry_->accept(chunk);
    case GtbChunkType::kPattern:
    case GtbChunkType::kTexture:
      if (!texture_) return corrupt("texture in a stream without it");
      if (level_of_geometry() <= level_of_texture()) return corrupt("geometry of level " + std::to_string(level_of_geometry()) + " expected, texture found");
      return texture_->accept(chunk);
    case GtbChunkType::kEnd: {
      Result<void> ok = check_end(chunk);
      has_ended_ = static_cast<bool>(ok);
      return ok;
    }
    case GtbChunkType::kMetadata: return {};
  }
  return corrupt("a chunk of unknown type");
}

Result<void> GtbModelDecoder::check_end(const GtbChunk& chunk) const {
  if ((geometry_ && !geometry_->is_complete()) || (texture_ && !texture_->is_complete())) return corrupt("chunk E before the last level is whole");
  const std::size_t selected = geometry_ ? geometry_->selected() : 0, fictitious = geometry_ ? geometry_->fictitious() : 0, classes = texture_ ? texture_->classes() : 0;
  if (chunk.payload != end_chunk(selected, fictitious, classes).payload) {
    return corrupt("chunk E does not agree with the " + std::to_string(selected) + " selected, " + std::to_string(fictitious) + " fictitious points and " +
                   std::to_string(classes) + " classes that came before it");
  }
  return {};
}

const std::vector<RgbImage>& GtbModelDecoder::patterns() const {
  static const std::vector<RgbImage> kNone;
  return texture_ ? texture_->patterns() : kNone;
}

}  // namespace lodestone
