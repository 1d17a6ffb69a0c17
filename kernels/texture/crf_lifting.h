#pragma once
// CRF(13,7) interpolating wavelet of colour images, in double. Source: Abasolo sec. 4 (WAILI's filter of that name).

#include <array>
#include <cstddef>
#include <span>
#include <vector>

#include "kernels/types/rgb_image.h"

namespace lodestone {

// One step along a line of any length >= 1, in place: lows first, then highs. Whole-sample symmetric extension. The inverse undoes it
// up to rounding.
void crf137_forward(std::span<double> x);
void crf137_inverse(std::span<double> x);

// Three planes of one size, row by row.
struct ColourBand {
  int width = 0, height = 0;
  std::array<std::vector<double>, 3> plane;

  std::size_t size() const { return static_cast<std::size_t>(width) * static_cast<std::size_t>(height); }
};

// low, and per level (finest first) the details HL (odd columns), LH (odd rows), HH.
struct ColourPyramid {
  int width = 0, height = 0;
  ColourBand low;
  std::vector<std::array<ColourBand, 3>> details;
};

ColourBand colour_band_of(const RgbImage& image);
ColourPyramid colour_pyramid(const ColourBand& image, int depth);
ColourBand image_of_pyramid(const ColourPyramid& pyramid);
// Rounds half up and clips to 0..255.
RgbImage rgb_image_of(const ColourBand& band);

}  // namespace lodestone
