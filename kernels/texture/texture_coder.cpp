#include "kernels/texture/texture_coder.h"

#include <algorithm>
#include <array>
#include <cassert>
#include <cstdlib>
#include <string>
#include <utility>

namespace lodestone {

namespace {

enum Token : std::uint8_t { kParent = 0, kLast = 1, kReference = 2, kNew = 3 };
constexpr std::size_t kUniformCells = 0, kParentCells = 128, kLastCells = 256, kNewCell = 260, kReferenceCells = 261;
constexpr std::size_t kAllCells = kReferenceCells + std::size_t{256} * 256;
constexpr int kNoParent = 255;

Error corrupt(std::string message) { return {ErrorCode::kCorrupt, "GTB stream: " + std::move(message)}; }

}  // namespace

TextureWalk::TextureWalk(int n) : n_(n), cells_(kAllCells) {}

// One token; wanted is the class to write. False when the class has no pattern.
template <class Coder>
bool TextureWalk::code_token(Coder& coder, int child, bool is_first_p, int parent, Triangle& triangle, int wanted) {
  const bool is_root = parent == kNoParent;
  const auto at = static_cast<std::size_t>(2 * child + (is_first_p ? 1 : 0));
  int value = 0;
  Token token = kReference;
  if (!is_root && coder.bit(cells_[kParentCells + static_cast<std::size_t>(4 * level_) + at], wanted == parent)) {
    token = kParent;
    value = parent;
  } else if (last_ >= 0 && (is_root || last_ != parent) && coder.bit(cells_[kLastCells + at], wanted == last_)) {
    token = kLast;
    value = last_;
  } else if (coder.bit(cells_[kNewCell], wanted == known_classes_)) {
    token = kNew;
    value = known_classes_;
    if (value >= allowed_classes_) return false;
    ++known_classes_;
  } else {
    std::size_t node = 1;
    for (int bit = 7; bit >= 0; --bit) {
      node = 2 * node + (coder.bit(cells_[kReferenceCells + 256 * static_cast<std::size_t>(parent) + node], (wanted >> bit & 1) != 0) ? 1 : 0);
    }
    value = static_cast<int>(node - 256);
    if (value >= known_classes_) return false;
  }
  last_ = value;
  triangle.value = static_cast<std::uint8_t>(value);
  triangle.how = token;
  return true;
}

template <class Coder>
bool TextureWalk::code_roots(Coder& coder, const TextureTree* tree) {
  for (std::uint32_t root = 0; root < 2; ++root) {
    Triangle triangle{root, 0, 0};
    if (!code_token(coder, static_cast<int>(root), false, kNoParent, triangle, tree != nullptr ? tree->classes[0][root] : 0)) return false;
    frontier_.push_back(triangle);
  }
  level_ = 0;
  return true;
}

template <class Coder>
bool TextureWalk::code_chunk(Coder& coder, std::size_t count, const TextureTree* tree) {
  const auto level = static_cast<std::size_t>(level_);
  for (const std::size_t stop = cursor_ + count; cursor_ < stop; ++cursor_) {
    const Triangle triangle = frontier_[cursor_];
    const bool wanted = tree != nullptr && tree->is_uniform[level][triangle.index] != 0;
    if (coder.bit(cells_[kUniformCells + 4 * level + triangle.how], wanted)) {
      leaves_.push_back({triangle.index, static_cast<std::uint8_t>(level_), triangle.value});
      continue;
    }
    bool is_first_p = false;
    for (std::uint32_t child = 0; child < 2; ++child) {
      Triangle part{2 * triangle.index + child, 0, 0};
      const int value = tree != nullptr ? tree->classes[level + 1][part.index] : 0;
      if (!code_token(coder, static_cast<int>(child), is_first_p, triangle.value, part, value)) return false;
      is_first_p = child == 0 && part.how == kParent;
      next_.push_back(part);
    }
  }
  return true;
}

void TextureWalk::finish_level_if_done() {
  if (level_ >= 0 && cursor_ == frontier_.size()) {
    frontier_ = std::exchange(next_, {});
    cursor_ = 0;
    ++level_;
    if (frontier_.empty()) level_ = 2 * n_;
  }
  // Half pixels are uniform without saying so.
  if (level_ < 2 * n_) return;
  for (const Triangle& triangle : frontier_) leaves_.push_back({triangle.index, static_cast<std::uint8_t>(2 * n_), triangle.value});
  frontier_.clear();
}

// Patterns: YCoCg-R, median prediction.

PatternCoder::PatternCoder() : cells_(kUintCells * 12) {}

template <class Coder>
bool PatternCoder::code(Coder& coder, int side, std::vector<std::int32_t>& planes) {
  const auto pixels = static_cast<std::size_t>(side) * static_cast<std::size_t>(side);
  for (std::size_t plane = 0; plane < 3; ++plane) {
    std::int32_t* const x = planes.data() + plane * pixels;
    for (int row = 0; row < side; ++row) {
      for (int col = 0; col < side; ++col) {
        std::int32_t* const at = x + static_cast<std::ptrdiff_t>(row) * side + col;
        std::int32_t predicted = plane == 0 ? 128 : 0;
        std::size_t activity = 0;
        if (row > 0 && col > 0) {
          const std::int32_t w = at[-1], n = at[-side], nw = at[-side - 1];
          predicted = nw >= std::max(w, n) ? std::min(w, n) : nw <= std::min(w, n) ? std::max(w, n) : w + n - nw;
          const std::int32_t g = std::abs(w - nw) + std::abs(n - nw);
          activity = g < 8 ? 1 : g < 32 ? 2 : 3;
        } else if (row > 0 || col > 0) {
          predicted = col > 0 ? at[-1] : at[-side];
          activity = 2;
        }
        const std::int32_t e = *at - predicted;
        const std::uint32_t zigzag = code_uint(coder, &cells_[kUintCells * (4 * plane + activity)], e >= 0 ? 2 * static_cast<std::uint32_t>(e) : 2 * static_cast<std::uint32_t>(-e) - 1);
        if (zigzag > 2048) return false;   // no two samples differ by more than 1024
        *at = predicted + ((zigzag & 1) != 0 ? -static_cast<std::int32_t>(zigzag / 2) - 1 : static_cast<std::int32_t>(zigzag / 2));
        if (std::abs(*at) > 512) return false;
      }
    }
  }
  return true;
}

std::vector<std::uint8_t> PatternCoder::encode(const RgbImage& pattern) {
  const std::size_t pixels = pattern.rgb.size() / 3;
  std::vector<std::int32_t> planes(3 * pixels);
  for (std::size_t at = 0; at < pixels; ++at) {
    const std::int32_t r = pattern.rgb[3 * at], g = pattern.rgb[3 * at + 1], b = pattern.rgb[3 * at + 2];
    const std::int32_t co = r - b, t = b + (co >> 1), cg = g - t;
    planes[at] = t + (cg >> 1);
    planes[pixels + at] = co;
    planes[2 * pixels + at] = cg;
  }
  RangeEncoder coder;
  const bool is_coded = code(coder, pattern.width, planes);
  assert(is_coded && "8-bit samples stay in range");
  static_cast<void>(is_coded);
  return coder.finish();
}

Result<RgbImage> PatternCoder::decode(std::span<const std::uint8_t> payload, int side) {
  const auto pixels = static_cast<std::size_t>(side) * static_cast<std::size_t>(side);
  std::vector<std::int32_t> planes(3 * pixels, 0);
  RangeDecoder coder(payload);
  if (!code(coder, side, planes)) return corrupt("a pattern's residual is out of range");
  RgbImage pattern{side, side, std::vector<std::uint8_t>(3 * pixels)};
  for (std::size_t at = 0; at < pixels; ++at) {
    const std::int32_t y = planes[at], co = planes[pixels + at], cg = planes[2 * pixels + at];
    const std::int32_t t = y - (cg >> 1), g = cg + t, b = t - (co >> 1), r = b + co;
    for (const std::int32_t sample : {r, g, b}) {
      if (sample < 0 || sample > 255) return corrupt("a pattern's colour is outside 0..255");
    }
    pattern.rgb[3 * at] = static_cast<std::uint8_t>(r);
    pattern.rgb[3 * at + 1] = static_cast<std::uint8_t>(g);
    pattern.rgb[3 * at + 2] = static_cast<std::uint8_t>(b);
  }
  return pattern;
}

TextureEncoder::TextureEncoder(const TextureTree& tree, std::span<const RgbImage> patterns) : TextureWalk(tree.n), patterns_(patterns), numbered_(tree) {
  // Renumbering by first use: the tokens' order is level by level, the order of the visited triangles.
  std::array<int, 256> number;
  number.fill(-1);
  int count = 0;
  std::vector<std::uint32_t> frontier{0, 1}, next;
  for (std::size_t level = 0; !frontier.empty(); ++level) {
    for (const std::uint32_t k : frontier) {
      int& own = number[tree.classes[level][k]];
      if (own < 0) {
        own = count++;
        order_.push_back(tree.classes[level][k]);
      }
      numbered_.classes[level][k] = static_cast<std::uint8_t>(own);
      if (tree.is_uniform[level][k] == 0) {
        next.push_back(2 * k);
        next.push_back(2 * k + 1);
      }
    }
    frontier = std::exchange(next, {});
  }
  allowed_classes_ = count;
}

std::optional<GtbChunk> TextureEncoder::next(int level) {
  if (!waiting_.empty()) {
    GtbChunk chunk = std::move(waiting_.back());
    waiting_.pop_back();
    return chunk;
  }
  if (level != level_ || level_ >= 2 * n_) return std::nullopt;
  const bool is_root = level_ < 0;
  const std::size_t count = is_root ? 2 : std::min<std::size_t>(frontier_.size() - cursor_, kGtbChunkTriangles);
  const int before = known_classes_;
  RangeEncoder coder;
  const bool is_coded = is_root ? code_roots(coder, &numbered_) : code_chunk(coder, count, &numbered_);
  assert(is_coded && "every class of the tree has its number");
  static_cast<void>(is_coded);
  finish_level_if_done();
  waiting_.push_back({GtbChunkType::kTexture, is_root ? kGtbRootLevel : static_cast<std::uint8_t>(level), static_cast<std::uint32_t>(count), coder.finish()});
  std::vector<GtbChunk> fresh;
  for (int k = before; k < known_classes_; ++k) {
    const RgbImage& pattern = patterns_[order_[static_cast<std::size_t>(k)]];
    fresh.push_back({GtbChunkType::kPattern, static_cast<std::uint8_t>(pattern.width), static_cast<std::uint32_t>(k), pattern_coder_.encode(pattern)});
  }
  waiting_.insert(waiting_.end(), std::make_move_iterator(fresh.rbegin()), std::make_move_iterator(fresh.rend()));
  return next(level);
}

TextureDecoder::TextureDecoder(const GtbHeader& header) : TextureWalk(header.n_tex), width_(header.texture_width), height_(header.texture_height) {}

Result<void> TextureDecoder::accept(const GtbChunk& chunk) {
  if (chunk.type == GtbChunkType::kPattern) {
    if (chunk.count != patterns_.size() || patterns_.size() >= 255) return corrupt("pattern " + std::to_string(patterns_.size()) + " expected (at most 255), pattern " + std::to_string(chunk.count) + " found");
    if (chunk.level == 0) return corrupt("a pattern of 1 to 255 pixels a side expected, 0 found");
    Result<RgbImage> pattern = pattern_coder_.decode(chunk.payload, chunk.level);
    if (!pattern) return std::move(pattern.error());
    patterns_.push_back(std::move(*pattern));
    allowed_classes_ = static_cast<int>(patterns_.size());
    return {};
  }
  const bool is_root = level_ < 0;
  const std::uint8_t wanted = is_root ? kGtbRootLevel : static_cast<std::uint8_t>(level_);
  if (chunk.type != GtbChunkType::kTexture || chunk.level != wanted || level_ >= 2 * n_ || chunk.count == 0 || chunk.count > kGtbChunkTriangles || chunk.count > triangles_left() ||
      (is_root && chunk.count != 2)) {
    return corrupt("texture of level " + std::to_string(wanted) + " with at most " + std::to_string(triangles_left()) + " triangles expected, " +
                   std::to_string(chunk.count) + " of level " + std::to_string(chunk.level) + " found");
  }
  const std::size_t cursor = cursor_, next = next_.size(), leaves = leaves_.size();
  const int known = known_classes_;
  RangeDecoder coder(chunk.payload);
  const bool is_good = is_root ? code_roots(coder, nullptr) : code_chunk(coder, chunk.count, nullptr);
  if (!is_good) {   // as before the chunk
    if (is_root) frontier_.clear();
    cursor_ = cursor;
    next_.resize(next);
    leaves_.resize(leaves);
    known_classes_ = known;
    return corrupt("a texture token names a class that has no pattern yet");
  }
  finish_level_if_done();
  return {};
}

std::vector<std::uint8_t> TextureDecoder::class_map() const {
  if (level_ < 0) return {};
  std::vector<std::uint8_t> map(static_cast<std::size_t>(width_) * static_cast<std::size_t>(height_), 0);
  const auto paint = [&](int level, std::uint32_t index, std::uint8_t value) { paint_texture_triangle(n_, level, index, value, map, width_, height_); };
  for (const Leaf& leaf : leaves_) paint(leaf.level, leaf.index, leaf.value);
  for (std::size_t k = cursor_; k < frontier_.size(); ++k) paint(level_, frontier_[k].index, frontier_[k].value);
  for (const Triangle& triangle : next_) paint(level_ + 1, triangle.index, triangle.value);
  return map;
}

}  // namespace lodestone
