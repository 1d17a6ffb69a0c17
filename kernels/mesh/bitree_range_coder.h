#pragma once
// Adaptive binary range coder of the GTB stream: LZMA's carry scheme, 16-bit probabilities that adapt faster while young.
// RangeEncoder and RangeDecoder have the same calls, so that one walk over the data serves both: a call takes the value to write
// (ignored when reading) and gives the value written or read.

#include <algorithm>
#include <bit>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

namespace lodestone {

struct RangeCell {
  std::uint16_t p = 32768;   // probability of 0, of 65536
  std::uint16_t k = 0;       // bits seen, up to 4: then the rate stays
};

inline std::uint32_t range_split(std::uint32_t range, RangeCell cell) {
  return (range >> 12) * std::clamp<std::uint32_t>(cell.p >> 4, 1, 4095);
}
inline void adapt(RangeCell& cell, bool bit) {
  const int rate = cell.k + 1;
  cell.p = static_cast<std::uint16_t>(bit ? cell.p - (cell.p >> rate) : cell.p + ((65536 - cell.p) >> rate));
  cell.k = static_cast<std::uint16_t>(cell.k < 4 ? cell.k + 1 : 4);
}

class RangeEncoder {
 public:
  static constexpr bool kReads = false;

  bool bit(RangeCell& cell, bool value) {
    const std::uint32_t split = range_split(range_, cell);
    if (value) {
      low_ += split;
      range_ -= split;
    } else {
      range_ = split;
    }
    adapt(cell, value);
    normalise();
    return value;
  }
  bool raw(bool value) {
    range_ >>= 1;
    if (value) low_ += range_;
    normalise();
    return value;
  }
  // Bytes of everything coded so far; the encoder is spent afterwards.
  std::vector<std::uint8_t> finish() {
    for (int i = 0; i < 5; ++i) shift_low();
    bytes_.erase(bytes_.begin());   // always 0
    while (!bytes_.empty() && bytes_.back() == 0) bytes_.pop_back();
    return std::move(bytes_);
  }

 private:
  void normalise() {
    while (range_ < 1U << 24) {
      range_ <<= 8;
      shift_low();
    }
  }
  void shift_low() {
    if (low_ < 0xff000000U || low_ > 0xffffffffU) {
      const auto carry = static_cast<std::uint8_t>(low_ >> 32);
      do {
        bytes_.push_back(static_cast<std::uint8_t>(held_ + carry));
        held_ = 0xff;
      } while (--held_count_ != 0);
      held_ = static_cast<std::uint8_t>(low_ >> 24);
    }
    ++held_count_;
    low_ = (low_ & 0x00ffffffU) << 8;
  }

  std::uint64_t low_ = 0;
  std::uint32_t range_ = 0xffffffffU;
  std::uint8_t held_ = 0;
  std::size_t held_count_ = 1;
  std::vector<std::uint8_t> bytes_;
};

class RangeDecoder {
 public:
  static constexpr bool kReads = true;

  // Reads zeros past the end. The bytes stay the caller's.
  explicit RangeDecoder(std::span<const std::uint8_t> bytes) : at_(bytes.data()), end_(bytes.data() + bytes.size()) {
    for (int i = 0; i < 4; ++i) code_ = code_ << 8 | next();
  }
  bool bit(RangeCell& cell, bool) {
    const std::uint32_t split = range_split(range_, cell);
    const bool value = code_ >= split;
    if (value) {
      code_ -= split;
      range_ -= split;
    } else {
      range_ = split;
    }
    adapt(cell, value);
    normalise();
    return value;
  }
  bool raw(bool) {
    range_ >>= 1;
    const bool value = code_ >= range_;
    if (value) code_ -= range_;
    normalise();
    return value;
  }

 private:
  std::uint32_t next() { return at_ != end_ ? *at_++ : 0; }
  void normalise() {
    while (range_ < 1U << 24) {
      range_ <<= 8;
      code_ = code_ << 8 | next();
    }
  }

  const std::uint8_t *at_, *end_;
  std::uint32_t range_ = 0xffffffffU, code_ = 0;
};

// Whole numbers 0..2^32 - 2 (Elias gamma with adaptive length and top mantissa bits). `cells` has kUintCells entries.
inline constexpr std::size_t kUintCells = 160;
template <class Coder>
std::uint32_t code_uint(Coder& coder, RangeCell* cells, std::uint32_t value) {
  const std::uint32_t v1 = value + 1;
  const int wanted = std::bit_width(v1) - 1;
  int bits = 0;
  while (bits < 31 && coder.bit(cells[bits], bits < wanted)) ++bits;
  std::uint32_t mantissa = 0;
  for (int i = bits - 1, depth = 0; i >= 0; --i, ++depth) {
    const bool b = (v1 >> i & 1) != 0;
    RangeCell* const cell = cells + 32 + 4 * bits + 1;
    const bool got = depth == 0 ? coder.bit(cell[0], b) : depth == 1 ? coder.bit(cell[1 + mantissa], b) : coder.raw(b);
    mantissa = mantissa << 1 | static_cast<std::uint32_t>(got);
  }
  return (1U << bits | mantissa) - 1;
}

}  // namespace lodestone
