#pragma once
// EXR height tiles: one part, scan lines, channel `Y` (float32 or half metres), row 0 north; optional half channel
// `provenance` (0 surveyed, 1 filled, 2 synthetic). The bytes are a pure function of the arguments.

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "kernels/types/result.h"

namespace lodestone {

enum class ExrCompression : std::uint8_t { kNone, kZip, kPiz, kPxr24 };
enum class ExrPixel : std::uint8_t { kFloat, kHalf };

// Attributes written into the header, besides the required ones: strings `layer recipe revision seed tile crs unit datum`, v2d
// `origin spacing`, v2f `height_range`. No text holds a NUL.
struct TileAttributes {
  std::string layer, recipe, revision, crs, unit = "metre", datum;
  std::uint64_t seed = 0;       // written as a decimal string
  int z = 0;
  std::int64_t x = 0, y = 0;    // written as decimal strings with the z: "z/x/y"
  double origin_x = 0, origin_y = 0;    // world coordinates of the north-west post
  double spacing_x = 0, spacing_y = 0;  // of neighbouring posts; spacing_y > 0 towards the south
  float height_min_m = 0, height_max_m = 0;
};

struct ExrOptions {
  ExrCompression compression = ExrCompression::kNone;
  ExrPixel pixel = ExrPixel::kFloat;
};

// heights_m: posts * posts. provenance: empty, or posts * posts of 0, 1, 2 (adds the channel).
// none, zip and piz keep every bit; pxr24 keeps 16 significant bits of a float: lossless only for quantised heights (quantum.h).
// half rounds to nearest even. Errors: kInvalidArgument (sizes, provenance over 2, half height beyond 65504 m), kInternal.
Result<std::string> encode_exr_tile(std::span<const float> heights_m, std::span<const std::uint8_t> provenance, int posts,
                                    const TileAttributes& attributes, const ExrOptions& options);

struct DecodedExr {
  int width = 0, height = 0;
  std::vector<float> heights_m;           // channel Y
  std::vector<std::uint8_t> provenance;   // empty when absent
};
// Reads back what encode_exr_tile wrote (and any single-part scan-line EXR with channel Y). Refuses declared sizes over
// max_pixels before it allocates. Errors: kCorrupt, kTooLarge, kUnsupported.
Result<DecodedExr> decode_exr_tile(std::span<const std::uint8_t> bytes, std::int64_t max_pixels = std::int64_t{1} << 24);

}  // namespace lodestone
