#pragma once
// New texture from a small pattern: coefficients of its wavelet pyramid change places within their class, then quadtree pasting makes
// larger and larger images. Source: Abasolo sec. 6. Pure: the same pattern, seed and class give the same bytes everywhere.

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "kernels/texture/crf_lifting.h"
#include "kernels/types/result.h"
#include "kernels/types/rgb_image.h"

namespace lodestone {

// Random numbers of one band: a splitmix64 stream whose state folds the keys.
class TextureRandom {
 public:
  explicit TextureRandom(std::span<const std::uint64_t> keys);
  std::uint64_t next();
  std::uint32_t below(std::uint32_t n) { return static_cast<std::uint32_t>(((next() >> 32) * n) >> 32); }

 private:
  std::uint64_t state_ = 0;
};

enum class PermutationMode : std::uint8_t { kFull, kFiftySwaps };   // Fisher-Yates per class, or 50 exchanges a band as published

// Class of every coefficient of a pattern's pyramid: low band first, then the three details of each level, coarsest first.
struct PyramidClasses {
  int depth = 0;
  struct Band {
    int width = 0, height = 0;
    std::vector<std::uint16_t> labels;
  };
  std::vector<Band> bands;   // 1 + 3 * depth
};
PyramidClasses classify_pattern(const RgbImage& pattern);

// Permutes coefficients within the classes, one permutation for the three colours. key and seed choose it.
void permute_pyramid(ColourPyramid& pyramid, const PyramidClasses& classes, std::uint64_t seed, std::uint64_t key, PermutationMode mode);

struct SynthesisOptions {
  std::uint64_t seed = 0;
  std::uint32_t texture_class = 0;
  PermutationMode mode = PermutationMode::kFull;
};
// A texture at least `side` pixels a side (pattern side times a power of two). Errors: kInvalidArgument (a pattern that is not square
// with a power of two of 4..128 pixels), kTooLarge (side over 8192).
Result<RgbImage> synthesise_texture(const RgbImage& pattern, int side, const SynthesisOptions& options);

// Fills a class map: pixel (row, col) of class k takes texel (row0 + row, col0 + col) of k's texture, repeated; row0, col0 >= 0 are the
// global place of the map's north-west pixel, so that neighbours join. texture_side: side of the textures before they repeat.
// Patterns that synthesis refuses are repeated as they are. Errors: kInvalidArgument for a class without a pattern.
Result<RgbImage> render_texture(std::span<const std::uint8_t> classes, int width, int height, std::span<const RgbImage> patterns, int texture_side, std::int64_t row0,
                                std::int64_t col0, std::uint64_t seed, PermutationMode mode = PermutationMode::kFull);

}  // namespace lodestone
