#pragma once
// A Geometric-Textured Bitree as a header and a list of chunks. kernels fill and read the payloads; storage/formats/gtb frames them
// into bytes with checksums. Format: docs/formats/gtb.md.

#include <array>
#include <cstdint>
#include <vector>

namespace lodestone {

struct GtbHeader {
  bool has_geometry = false, has_texture = false;
  std::uint8_t n_geo = 0, n_tex = 0;      // 2^n_geo + 1 posts, 2^n_tex pixels a side of the bisected square
  std::uint8_t predictor = 2;
  std::uint8_t pattern_side = 0;          // the usual one, pixels; 0 without texture
  double z_offset_m = 0, z_step_m = 1;    // height = z_offset_m + z_step_m * q
  std::array<std::int32_t, 4> corner_q{};   // NW NE SW SE
  std::uint16_t texture_width = 0, texture_height = 0;   // pixels; the rest of the square has no weight
  bool operator==(const GtbHeader&) const = default;
};

// On disk: never renumber.
enum class GtbChunkType : std::uint8_t { kMetadata = 'M', kGeometry = 'G', kPattern = 'P', kTexture = 'T', kEnd = 'E' };
inline constexpr std::uint8_t kGtbRootLevel = 255;        // level of the texture chunk of the two roots
inline constexpr std::uint32_t kGtbChunkTriangles = 4096;   // at most, in one chunk

struct GtbChunk {
  GtbChunkType type = GtbChunkType::kEnd;
  std::uint8_t level = 0;        // of the triangles; side of a pattern; 0 else
  std::uint32_t count = 0;       // triangles; class of a pattern; 0 else
  std::vector<std::uint8_t> payload;
  bool operator==(const GtbChunk&) const = default;
};

struct GtbStream {
  GtbHeader header;
  std::vector<GtbChunk> chunks;   // without metadata
};

}  // namespace lodestone
