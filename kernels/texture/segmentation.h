#pragma once
// Texture classes of an image and a small pattern for each. Source: Abasolo sec. 4 and 4.1.

#include <cstddef>
#include <cstdint>
#include <vector>

#include "kernels/texture/isodata.h"
#include "kernels/types/result.h"
#include "kernels/types/rgb_image.h"

namespace lodestone {

inline constexpr int kMaxTextureClasses = 255;
inline constexpr int kPatternSide = 16, kSmallPatternSide = 8;

struct SegmentationOptions {
  IsodataOptions coarse;                                          // on LL2
  IsodataOptions refine{1, 4, 0.7 * 24, 0.7 * 24, 4, 12};         // each class again, on its pixels of LL1
};

struct TextureSegmentation {
  int width = 0, height = 0;
  std::vector<std::uint8_t> classes;       // per pixel, row 0 north
  std::vector<Colour> means;               // per class, of the image's pixels in it
  std::vector<RgbImage> patterns;          // per class, 16 or 8 pixels a side, mean = that of the class (up to rounding and clipping)
  std::size_t classes_before = 0;          // before those without an 8 x 8 pattern were dissolved
};

// Classifies the image from coarse to fine (CRF(13,7), low bands of depth 2), dissolves classes without an own 8 x 8 square one at a time
// (fewest pixels first, into the class of nearest mean colour), and cuts a pattern for every class left.
// Needs at least 8 x 8 pixels, at most 8192 a side. Errors: kInvalidArgument, kTooLarge (sides; over 255 classes left).
Result<TextureSegmentation> segment_texture(const RgbImage& image, const SegmentationOptions& options = {});

}  // namespace lodestone
