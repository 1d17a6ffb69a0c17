#include "storage/formats/gtb.h"

#include <libdeflate.h>

#include <bit>
#include <cmath>
#include <cstring>
#include <nlohmann/json.hpp>
#include <utility>

namespace lodestone {

namespace {

// On disk: never renumber.
constexpr char kMagic[4] = {'G', 'T', 'B', '1'};
constexpr std::uint8_t kVersion = 1, kGeometryFlag = 1, kTextureFlag = 2, kPredictor = 2;
constexpr std::int32_t kLatticeLimit = 1 << 26;
constexpr std::size_t kCrcBytes = 4, kEndPayload = 12;

template <class T>
void put(std::string& out, T value) {
  static_assert(std::endian::native == std::endian::little);
  char bytes[sizeof(T)];
  std::memcpy(bytes, &value, sizeof(T));
  out.append(bytes, sizeof(T));
}
template <class T>
T get(std::span<const std::uint8_t> bytes, std::size_t at) {
  T value;
  std::memcpy(&value, bytes.data() + at, sizeof(T));
  return value;
}
void put_uvarint(std::string& out, std::uint64_t value) {
  for (; value >= 0x80; value >>= 7) out.push_back(static_cast<char>((value & 0x7f) | 0x80));
  out.push_back(static_cast<char>(value));
}
void put_crc(std::string& out) { put(out, static_cast<std::uint32_t>(libdeflate_crc32(0, out.data(), out.size()))); }

enum class Varint { kGood, kShort, kBad };
// Shortest form of at most 32 bits only: one value has one spelling.
Varint get_uvarint(std::span<const std::uint8_t> bytes, std::size_t& at, std::uint32_t& value) {
  std::uint64_t sum = 0;
  for (int shift = 0; shift < 35; shift += 7) {
    if (at >= bytes.size()) return Varint::kShort;
    const std::uint8_t byte = bytes[at++];
    sum |= static_cast<std::uint64_t>(byte & 0x7f) << shift;
    if (byte < 0x80) {
      if (sum > 0xffffffffU || (byte == 0 && shift > 0)) return Varint::kBad;
      value = static_cast<std::uint32_t>(sum);
      return Varint::kGood;
    }
  }
  return Varint::kBad;
}

// Three significant digits, never below the value.
double rounded_up(double value) {
  if (!(value > 0) || !std::isfinite(value)) return 0;
  const double unit = std::pow(10.0, std::floor(std::log10(value)) - 2);
  double up = std::ceil(value / unit) * unit;
  while (up < value) up = std::nextafter(up, HUGE_VAL);
  char text[32];
  std::snprintf(text, sizeof text, "%.3g", up);   // the short decimal, unless it fell below
  const double brief = std::strtod(text, nullptr);
  return brief >= value ? brief : up;
}

}  // namespace

std::string gtb_header_bytes(const GtbHeader& header) {
  std::string out(kMagic, sizeof kMagic);
  put(out, kVersion);
  put(out, static_cast<std::uint8_t>((header.has_geometry ? kGeometryFlag : 0) | (header.has_texture ? kTextureFlag : 0)));
  put(out, header.n_geo);
  put(out, header.n_tex);
  put(out, header.predictor);
  put(out, header.pattern_side);
  put(out, std::uint16_t{0});
  put(out, header.z_offset_m);
  put(out, header.z_step_m);
  for (const std::int32_t q : header.corner_q) put(out, q);
  put(out, header.texture_width);
  put(out, header.texture_height);
  put_crc(out);
  return out;
}

std::string gtb_chunk_bytes(const GtbChunk& chunk) {
  std::string out;
  out.reserve(chunk.payload.size() + 16);
  put(out, static_cast<std::uint8_t>(chunk.type));
  put(out, chunk.level);
  put_uvarint(out, chunk.count);
  put_uvarint(out, chunk.payload.size());
  out.append(chunk.payload.begin(), chunk.payload.end());
  put_crc(out);
  return out;
}

std::string gtb_metadata_bytes(const GtbMetadata& metadata) {
  nlohmann::json json = nlohmann::json::object();
  if (metadata.max_error_m) json["max_error_m"] = *metadata.max_error_m;
  if (metadata.rms_error_m) json["rms_error_m"] = *metadata.rms_error_m;
  if (!metadata.error_bounds_m.empty()) {
    nlohmann::json& bounds = json["error_bounds_m"] = nlohmann::json::array();
    for (const double bound : metadata.error_bounds_m) bounds.push_back(rounded_up(bound));
  }
  for (const auto& [key, text] : metadata.texts) json["texts"][key] = text;
  const std::string text = json.dump(-1, ' ', false, nlohmann::json::error_handler_t::replace);
  return gtb_chunk_bytes({GtbChunkType::kMetadata, 0, 0, {text.begin(), text.end()}});
}

std::string encode_gtb(const GtbStream& stream, const GtbMetadata* metadata) {
  std::string out = gtb_header_bytes(stream.header);
  if (metadata != nullptr) out += gtb_metadata_bytes(*metadata);
  for (const GtbChunk& chunk : stream.chunks) out += gtb_chunk_bytes(chunk);
  return out;
}

std::string GtbReader::place() const { return "GTB stream, byte " + std::to_string(good_bytes_) + ": "; }

Result<void> GtbReader::push(std::span<const std::uint8_t> bytes) {
  if (has_failed_) return Error{ErrorCode::kCorrupt, place() + "reading stopped here"};
  if (has_ended_ && !bytes.empty()) {
    has_failed_ = true;
    return Error{ErrorCode::kCorrupt, place() + "the end expected after chunk E, more bytes found"};
  }
  std::span<const std::uint8_t> rest = bytes;
  if (!pending_.empty()) {
    pending_.insert(pending_.end(), bytes.begin(), bytes.end());
    rest = pending_;
  }
  while (!rest.empty()) {
    std::size_t used = 0;
    Result<bool> piece = read_piece(rest, used);
    if (!piece) {
      has_failed_ = true;
      pending_.clear();
      return std::move(piece.error());
    }
    if (!*piece) break;
    good_bytes_ += used;
    rest = rest.subspan(used);
    if (has_ended_ && !rest.empty()) {
      has_failed_ = true;
      pending_.clear();
      return Error{ErrorCode::kCorrupt, place() + "the end expected after chunk E, more bytes found"};
    }
  }
  // A long chunk that arrives in small pieces only grows: it is not copied again each time.
  if (pending_.empty() || rest.size() != pending_.size()) pending_ = std::vector<std::uint8_t>(rest.begin(), rest.end());
  return {};
}

Result<bool> GtbReader::read_piece(std::span<const std::uint8_t> rest, std::size_t& used) {
  return header_ ? read_chunk(rest, used) : read_header(rest, used);
}

Result<bool> GtbReader::read_header(std::span<const std::uint8_t> rest, std::size_t& used) {
  if (std::memcmp(rest.data(), kMagic, std::min(rest.size(), sizeof kMagic)) != 0) return Error{ErrorCode::kCorrupt, place() + "\"GTB1\" expected; this is not a GTB stream"};
  if (rest.size() < kGtbHeaderBytes) return false;
  if (libdeflate_crc32(0, rest.data(), kGtbHeaderBytes - kCrcBytes) != get<std::uint32_t>(rest, kGtbHeaderBytes - kCrcBytes)) {
    return Error{ErrorCode::kCorrupt, place() + "the header fails its checksum"};
  }
  if (rest[4] != kVersion) return Error{ErrorCode::kUnsupported, place() + "version 1 expected, " + std::to_string(rest[4]) + " found"};
  const std::uint8_t flags = rest[5];
  if (flags == 0 || flags > (kGeometryFlag | kTextureFlag)) return Error{ErrorCode::kUnsupported, place() + "flags 1 to 3 expected, " + std::to_string(flags) + " found"};
  GtbHeader header;
  header.has_geometry = (flags & kGeometryFlag) != 0;
  header.has_texture = (flags & kTextureFlag) != 0;
  header.n_geo = rest[6];
  header.n_tex = rest[7];
  header.predictor = rest[8];
  header.pattern_side = rest[9];
  header.z_offset_m = get<double>(rest, 12);
  header.z_step_m = get<double>(rest, 20);
  for (std::size_t i = 0; i < 4; ++i) header.corner_q[i] = get<std::int32_t>(rest, 28 + 4 * i);
  header.texture_width = get<std::uint16_t>(rest, 44);
  header.texture_height = get<std::uint16_t>(rest, 46);

  if (get<std::uint16_t>(rest, 10) != 0) return Error{ErrorCode::kUnsupported, place() + "reserved header bytes are not 0"};
  if (header.has_geometry) {
    if (header.n_geo < 1 || header.n_geo > limits_.max_n_geo) {
      return Error{ErrorCode::kTooLarge, place() + "a tile of 2^1 to 2^" + std::to_string(limits_.max_n_geo) + " cells a side expected, 2^" + std::to_string(header.n_geo) + " found"};
    }
    if (header.predictor != kPredictor) return Error{ErrorCode::kUnsupported, place() + "predictor 2 expected, " + std::to_string(header.predictor) + " found"};
    if (!std::isfinite(header.z_offset_m) || !std::isfinite(header.z_step_m) || header.z_step_m <= 0) return Error{ErrorCode::kCorrupt, place() + "the height step must be above 0, step and offset finite"};
    for (const std::int32_t q : header.corner_q) {
      if (q <= -kLatticeLimit || q >= kLatticeLimit) return Error{ErrorCode::kCorrupt, place() + "a corner height is 2^26 steps or more from the offset"};
    }
  } else if (header.n_geo != 0) {
    return Error{ErrorCode::kCorrupt, place() + "a stream without geometry has n_geo 0, " + std::to_string(header.n_geo) + " found"};
  }
  if (header.has_texture) {
    const std::uint32_t square = header.n_tex <= limits_.max_n_tex ? 1U << header.n_tex : 0;
    if (square == 0) {
      return Error{ErrorCode::kTooLarge, place() + "a texture of at most 2^" + std::to_string(limits_.max_n_tex) + " pixels a side expected, 2^" + std::to_string(header.n_tex) + " found"};
    }
    if (header.texture_width == 0 || header.texture_height == 0 || header.texture_width > square || header.texture_height > square) {
      return Error{ErrorCode::kCorrupt, place() + "a texture of 1 to " + std::to_string(square) + " pixels a side expected, " + std::to_string(header.texture_width) + " x " + std::to_string(header.texture_height) + " found"};
    }
  } else if (header.n_tex != 0 || header.texture_width != 0 || header.texture_height != 0) {
    return Error{ErrorCode::kCorrupt, place() + "a stream without texture has no texture size"};
  }
  header_ = header;
  used = kGtbHeaderBytes;
  return true;
}

Result<bool> GtbReader::read_chunk(std::span<const std::uint8_t> rest, std::size_t& used) {
  const std::uint8_t type = rest[0];
  const bool is_known = type == 'M' || type == 'G' || type == 'P' || type == 'T' || type == 'E';
  if (!is_known) return Error{ErrorCode::kCorrupt, place() + "a chunk M, G, P, T or E expected, byte " + std::to_string(type) + " found"};
  std::size_t at = 2;
  std::uint32_t count = 0, size = 0;
  for (std::uint32_t* const value : {&count, &size}) {
    const Varint read = get_uvarint(rest, at, *value);
    if (read == Varint::kShort) return false;
    if (read == Varint::kBad) return Error{ErrorCode::kCorrupt, place() + "a chunk's count or length is not a shortest 32-bit varint"};
  }
  if (size > (type == 'M' ? limits_.max_metadata_bytes : limits_.max_payload_bytes)) {
    return Error{ErrorCode::kTooLarge, place() + "a chunk of " + std::to_string(size) + " bytes is over the limit"};
  }
  if ((type == 'G' || type == 'T') && (count == 0 || count > kGtbChunkTriangles)) {
    return Error{ErrorCode::kCorrupt, place() + "1 to 4096 triangles expected in a chunk, " + std::to_string(count) + " found"};
  }
  if (rest.size() - at < size + kCrcBytes) return false;
  const std::size_t checked = at + size;
  if (libdeflate_crc32(0, rest.data(), checked) != get<std::uint32_t>(rest, checked)) return Error{ErrorCode::kCorrupt, place() + "a chunk fails its checksum"};

  const std::span<const std::uint8_t> payload = rest.subspan(at, size);
  used = checked + kCrcBytes;
  if (type == 'M') {
    if (has_chunks_ || metadata_) return Error{ErrorCode::kCorrupt, place() + "metadata stands once, right after the header"};
    if (Result<void> ok = read_metadata(payload); !ok) return std::move(ok.error());
    return true;
  }
  if (type == 'E' && size != kEndPayload) return Error{ErrorCode::kCorrupt, place() + "12 bytes expected in chunk E, " + std::to_string(size) + " found"};
  has_chunks_ = true;
  has_ended_ = type == 'E';
  chunks_.push_back({static_cast<GtbChunkType>(type), rest[1], count, {payload.begin(), payload.end()}});
  return true;
}

Result<void> GtbReader::read_metadata(std::span<const std::uint8_t> payload) {
  const nlohmann::json json = nlohmann::json::parse(payload.begin(), payload.end(), nullptr, false);
  if (!json.is_object()) return Error{ErrorCode::kCorrupt, place() + "the metadata is no JSON object"};
  GtbMetadata metadata;
  const auto number = [&](const char* name) -> std::optional<double> {
    const auto found = json.find(name);
    return found != json.end() && found->is_number() ? std::optional(found->get<double>()) : std::nullopt;
  };
  metadata.max_error_m = number("max_error_m");
  metadata.rms_error_m = number("rms_error_m");
  if (const auto bounds = json.find("error_bounds_m"); bounds != json.end() && bounds->is_array()) {
    for (const auto& bound : *bounds) metadata.error_bounds_m.push_back(bound.is_number() ? bound.get<double>() : HUGE_VAL);
  }
  if (const auto texts = json.find("texts"); texts != json.end() && texts->is_object()) {
    for (const auto& [key, text] : texts->items()) {
      if (text.is_string()) metadata.texts[key] = text.get<std::string>();
    }
  }
  metadata_ = std::move(metadata);
  return {};
}

std::vector<GtbChunk> GtbReader::take() { return std::exchange(chunks_, {}); }

Result<GtbPrefix> decode_gtb(std::span<const std::uint8_t> bytes, const GtbLimits& limits) {
  GtbReader reader(limits);
  GtbPrefix prefix;
  if (Result<void> ok = reader.push(bytes); !ok) {
    if (!reader.header()) return std::move(ok.error());
    prefix.stopped = ok.error().message;
  }
  if (!reader.header()) {
    return Error{ErrorCode::kCorrupt, "GTB stream: a header of 52 bytes expected, " + std::to_string(bytes.size()) + " bytes found"};
  }
  prefix.stream = {*reader.header(), reader.take()};
  prefix.metadata = reader.metadata();
  prefix.good_bytes = reader.good_bytes();
  prefix.is_complete = reader.is_complete();
  return prefix;
}

}  // namespace lodestone
