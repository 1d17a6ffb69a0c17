#include "storage/dem/tile_codec.h"

#include <xxhash.h>
#include <zstd.h>

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>
#include <memory>

static_assert(std::endian::native == std::endian::little, "stored values are little-endian");

namespace lodestone {
namespace {

constexpr int kZstdLevel = 1;
constexpr char kTileMagic[4] = {'L', 'S', 'D', 'T'};
constexpr char kTextMagic[4] = {'L', 'S', 'T', 'X'};
constexpr std::uint8_t kVersion = 1;
enum HeightEncoding : std::uint8_t { kConstant = 0, kInt16 = 1, kFloatBits = 2 };  // on disk: never renumber

struct Header {
  char magic[4];
  std::uint8_t version;
  std::uint8_t encoding;
  std::uint8_t void_mode;
  std::uint8_t zero;
  std::uint32_t width, height;
  std::uint32_t height_bytes;  // of the packed heights
  std::uint32_t void_bytes;    // of the packed bitmap
  std::uint32_t header_check;  // low half of XXH3-64 over the 24 bytes before, seeded with the key
  std::uint32_t zero2;
};
static_assert(sizeof(Header) == 32);
constexpr std::size_t kCheckedHeader = 24;
constexpr std::size_t kPrefix = sizeof(Header) + 8;

std::uint64_t key_seed(std::string_view key) { return XXH3_64bits(key.data(), key.size()); }

std::uint64_t body_check(std::span<const std::uint8_t> value, std::uint64_t seed) {
  const std::uint64_t head = XXH3_64bits_withSeed(value.data(), sizeof(Header), seed);
  return XXH3_64bits_withSeed(value.data() + kPrefix, value.size() - kPrefix, head);
}

struct ZstdCloser {
  void operator()(ZSTD_CCtx* c) const noexcept { ZSTD_freeCCtx(c); }
  void operator()(ZSTD_DCtx* c) const noexcept { ZSTD_freeDCtx(c); }
};

// Appends the zstd frame of `raw` to `out` and returns its size. Packed aside: many values wait in memory at
// once, and must not hold on to the room that zstd might have needed.
std::uint32_t append_packed(std::vector<std::uint8_t>& out, std::span<const std::uint8_t> raw) {
  thread_local const std::unique_ptr<ZSTD_CCtx, ZstdCloser> context(ZSTD_createCCtx());
  thread_local std::vector<std::uint8_t> packed;
  packed.resize(ZSTD_compressBound(raw.size()));
  const std::size_t size =
      ZSTD_compressCCtx(context.get(), packed.data(), packed.size(), raw.data(), raw.size(), kZstdLevel);
  assert(!ZSTD_isError(size) && "zstd failed in a buffer of its own bound");
  out.insert(out.end(), packed.begin(), packed.begin() + static_cast<std::ptrdiff_t>(size));
  return static_cast<std::uint32_t>(size);
}

bool unpack(std::span<const std::uint8_t> packed, std::span<std::uint8_t> raw) {
  thread_local const std::unique_ptr<ZSTD_DCtx, ZstdCloser> context(ZSTD_createDCtx());
  const std::size_t size =
      ZSTD_decompressDCtx(context.get(), raw.data(), raw.size(), packed.data(), packed.size());
  return !ZSTD_isError(size) && size == raw.size();
}

// Integral within int16, and the same bits after the round trip (so no -0.0).
bool is_int16(std::span<const float> h) {
  bool ok = true;
  for (const float v : h) {
    const bool in_range = v >= -32768.0F && v <= 32767.0F;
    const float back = in_range ? static_cast<float>(static_cast<std::int32_t>(v)) : 0.0F;
    ok &= in_range && std::bit_cast<std::uint32_t>(back) == std::bit_cast<std::uint32_t>(v);
  }
  return ok;
}

// Differences along the row (the first post of a row: from the one above), zigzag, split into planes of
// bytes, low first.
template <class U>
void to_planes(std::span<const U> v, std::size_t width, std::vector<std::uint8_t>& planes) {
  const std::size_t n = v.size();
  planes.resize(n * sizeof(U));
  for (std::size_t k = 0; k < n; ++k) {
    const U before = k % width != 0 ? v[k - 1] : (k != 0 ? v[k - width] : U{0});
    const U d = static_cast<U>(v[k] - before);
    const U sign = static_cast<U>(-(d >> (8 * sizeof(U) - 1)));
    const U z = static_cast<U>(static_cast<U>(d << 1) ^ sign);
    for (std::size_t b = 0; b < sizeof(U); ++b) planes[b * n + k] = static_cast<std::uint8_t>(z >> (8 * b));
  }
}

template <class U>
void from_planes(std::span<const std::uint8_t> planes, std::size_t width, std::span<U> v) {
  const std::size_t n = v.size();
  for (std::size_t row = 0; row < n; row += width) {
    U before = row != 0 ? v[row - width] : U{0};
    for (std::size_t k = row; k < row + width; ++k) {
      U z = 0;
      for (std::size_t b = 0; b < sizeof(U); ++b)
        z = static_cast<U>(z | static_cast<U>(static_cast<U>(planes[b * n + k]) << (8 * b)));
      const U d = static_cast<U>((z >> 1) ^ static_cast<U>(-(z & 1)));
      before = static_cast<U>(before + d);
      v[k] = before;
    }
  }
}

Error damaged(const std::string& what) { return Error{ErrorCode::kCorrupt, "tile value: " + what}; }

Result<Header> read_header(std::span<const std::uint8_t> value, std::uint64_t seed) {
  if (value.size() < kPrefix) {
    return damaged("at least " + std::to_string(kPrefix) + " bytes expected, " +
                   std::to_string(value.size()) + " found");
  }
  Header h{};
  std::memcpy(&h, value.data(), sizeof h);
  if (std::memcmp(h.magic, kTileMagic, 4) != 0 || h.version != kVersion)
    return damaged("wrong magic or version");
  if (h.header_check !=
      static_cast<std::uint32_t>(XXH3_64bits_withSeed(value.data(), kCheckedHeader, seed))) {
    return damaged("header checksum differs");
  }
  return h;
}

}  // namespace

std::string tile_key(const TileId& id) {
  std::string key(10, 't');
  key[1] = static_cast<char>(id.z);
  for (int b = 0; b < 4; ++b) {
    key[static_cast<std::size_t>(2 + b)] = static_cast<char>(id.y >> (24 - 8 * b));
    key[static_cast<std::size_t>(6 + b)] = static_cast<char>(id.x >> (24 - 8 * b));
  }
  return key;
}

std::vector<std::uint8_t> encode_tile(const HeightGrid& tile, std::string_view key) {
  thread_local std::vector<std::uint8_t> planes;
  const std::size_t n = tile.heights_m.size();
  const auto width = static_cast<std::size_t>(tile.window.width());
  Header h{};
  std::memcpy(h.magic, kTileMagic, 4);
  h.version = kVersion;
  h.width = static_cast<std::uint32_t>(tile.window.width());
  h.height = static_cast<std::uint32_t>(tile.window.height());
  std::vector<std::uint8_t> out(kPrefix);

  const float* first = tile.heights_m.data();
  const bool is_constant = std::all_of(tile.heights_m.begin(), tile.heights_m.end(), [first](float v) {
    return std::bit_cast<std::uint32_t>(v) == std::bit_cast<std::uint32_t>(*first);
  });
  if (is_constant) {
    h.encoding = kConstant;
    h.height_bytes = 4;
    out.resize(kPrefix + 4);
    std::memcpy(out.data() + kPrefix, first, 4);
  } else if (is_int16(tile.heights_m)) {
    h.encoding = kInt16;
    thread_local std::vector<std::uint16_t> v;
    v.resize(n);
    for (std::size_t k = 0; k < n; ++k)
      v[k] = static_cast<std::uint16_t>(static_cast<std::int32_t>(tile.heights_m[k]));
    to_planes<std::uint16_t>(v, width, planes);
    h.height_bytes = append_packed(out, planes);
  } else {
    h.encoding = kFloatBits;
    thread_local std::vector<std::uint32_t> v;
    v.resize(n);
    std::memcpy(v.data(), first, n * 4);
    to_planes<std::uint32_t>(v, width, planes);
    h.height_bytes = append_packed(out, planes);
  }

  const auto voids =
      static_cast<std::size_t>(std::count(tile.is_void.begin(), tile.is_void.end(), std::uint8_t{1}));
  if (voids == n && n > 0) {
    h.void_mode = static_cast<std::uint8_t>(VoidMode::kAll);
  } else if (voids > 0) {
    h.void_mode = static_cast<std::uint8_t>(VoidMode::kSome);
    std::vector<std::uint8_t> bits((n + 7) / 8);
    for (std::size_t k = 0; k < n; ++k)
      bits[k / 8] = static_cast<std::uint8_t>(bits[k / 8] | (tile.is_void[k] << (k % 8)));
    h.void_bytes = append_packed(out, bits);
  }

  const std::uint64_t seed = key_seed(key);
  h.header_check = static_cast<std::uint32_t>(XXH3_64bits_withSeed(&h, kCheckedHeader, seed));
  std::memcpy(out.data(), &h, sizeof h);
  const std::uint64_t check = body_check(out, seed);
  std::memcpy(out.data() + sizeof h, &check, sizeof check);
  return out;
}

Result<HeightGrid> decode_tile(std::span<const std::uint8_t> value, std::string_view key,
                               const PostWindow& window) {
  const std::uint64_t seed = key_seed(key);
  auto header = read_header(value, seed);
  if (!header) return header.error();
  const Header& h = *header;
  std::uint64_t check = 0;
  std::memcpy(&check, value.data() + sizeof(Header), sizeof check);
  if (check != body_check(value, seed)) return damaged("checksum differs");
  if (h.width != window.width() || h.height != window.height()) {
    return damaged(std::to_string(window.width()) + " x " + std::to_string(window.height()) +
                   " posts expected, " + std::to_string(h.width) + " x " + std::to_string(h.height) +
                   " found");
  }
  if (kPrefix + std::size_t{h.height_bytes} + h.void_bytes != value.size())
    return damaged("sizes do not add up");

  HeightGrid tile;
  tile.window = window;
  const std::size_t n = std::size_t{h.width} * h.height;
  tile.heights_m.resize(n);
  const auto packed = value.subspan(kPrefix, h.height_bytes);
  thread_local std::vector<std::uint8_t> planes;
  if (h.encoding == kConstant && packed.size() == 4) {
    float v = 0;
    std::memcpy(&v, packed.data(), 4);
    std::fill(tile.heights_m.begin(), tile.heights_m.end(), v);
  } else if (h.encoding == kInt16) {
    planes.resize(n * 2);
    if (!unpack(packed, planes)) return damaged("heights do not unpack");
    thread_local std::vector<std::uint16_t> v;
    v.resize(n);
    from_planes<std::uint16_t>(planes, h.width, v);
    for (std::size_t k = 0; k < n; ++k)
      tile.heights_m[k] = static_cast<float>(static_cast<std::int16_t>(v[k]));
  } else if (h.encoding == kFloatBits) {
    planes.resize(n * 4);
    if (!unpack(packed, planes)) return damaged("heights do not unpack");
    thread_local std::vector<std::uint32_t> v;
    v.resize(n);
    from_planes<std::uint32_t>(planes, h.width, v);
    std::memcpy(tile.heights_m.data(), v.data(), n * 4);
  } else {
    return damaged("unknown encoding " + std::to_string(h.encoding));
  }

  if (h.void_mode == static_cast<std::uint8_t>(VoidMode::kAll)) {
    tile.is_void.assign(n, 1);
  } else if (h.void_mode == static_cast<std::uint8_t>(VoidMode::kSome)) {
    std::vector<std::uint8_t> bits((n + 7) / 8);
    if (!unpack(value.subspan(kPrefix + h.height_bytes, h.void_bytes), bits))
      return damaged("void flags do not unpack");
    tile.is_void.resize(n);
    for (std::size_t k = 0; k < n; ++k) tile.is_void[k] = (bits[k / 8] >> (k % 8)) & 1;
  }
  return tile;
}

Result<VoidMode> tile_void_mode(std::span<const std::uint8_t> value, std::string_view key) {
  auto header = read_header(value, key_seed(key));
  if (!header) return header.error();
  return static_cast<VoidMode>(header->void_mode);
}

std::vector<std::uint8_t> encode_text(std::string_view text, std::string_view key) {
  std::vector<std::uint8_t> out(16 + text.size());
  std::memcpy(out.data(), kTextMagic, 4);
  const std::uint64_t check = XXH3_64bits_withSeed(text.data(), text.size(), key_seed(key));
  std::memcpy(out.data() + 8, &check, 8);
  if (!text.empty()) std::memcpy(out.data() + 16, text.data(), text.size());
  return out;
}

Result<std::string> decode_text(std::span<const std::uint8_t> value, std::string_view key) {
  std::uint64_t check = 0;
  if (value.size() < 16 || std::memcmp(value.data(), kTextMagic, 4) != 0) {
    return Error{ErrorCode::kCorrupt, "text value: wrong magic"};
  }
  std::memcpy(&check, value.data() + 8, 8);
  std::string text(reinterpret_cast<const char*>(value.data()) + 16, value.size() - 16);
  if (check != XXH3_64bits_withSeed(text.data(), text.size(), key_seed(key))) {
    return Error{ErrorCode::kCorrupt, "text value: checksum differs"};
  }
  return text;
}

}  // namespace lodestone
