#include "kernels/texture/crf_lifting.h"

#include <algorithm>
#include <cmath>

namespace lodestone {

namespace {

// Index inside [0, count) of a line that is mirrored about its first and last sample.
std::ptrdiff_t mirrored(std::ptrdiff_t i, std::ptrdiff_t count) {
  if (count == 1) return 0;
  const std::ptrdiff_t period = 2 * (count - 1);
  i = std::abs(i) % period;
  return i < count ? i : period - i;
}

// Adds sign * step to the samples of one parity: four neighbours of the other parity at distances 3, 1, 1, 3.
void lift(std::span<double> x, std::ptrdiff_t first, double outer, double inner, double sign) {
  const auto count = static_cast<std::ptrdiff_t>(x.size());
  const auto at = [&](std::ptrdiff_t i) { return x[static_cast<std::size_t>(mirrored(i, count))]; };
  for (std::ptrdiff_t i = first; i < count; i += 2) {
    double sum;
    if (i >= 3 && i + 3 < count) {
      const double* const p = x.data() + i;
      sum = outer * (p[-3] + p[3]) + inner * (p[-1] + p[1]);
    } else {
      sum = outer * (at(i - 3) + at(i + 3)) + inner * (at(i - 1) + at(i + 1));
    }
    x[static_cast<std::size_t>(i)] += sign * (sum / 16);
  }
}

template <class Step>
void over_rows_and_columns(ColourBand& band, bool columns_first, Step&& step) {
  std::vector<double> line(static_cast<std::size_t>(band.height));
  for (std::vector<double>& plane : band.plane) {
    for (int pass = 0; pass < 2; ++pass) {
      if ((pass == 0) == columns_first) {
        for (int col = 0; col < band.width; ++col) {
          for (int row = 0; row < band.height; ++row) line[static_cast<std::size_t>(row)] = plane[static_cast<std::size_t>(row) * static_cast<std::size_t>(band.width) + static_cast<std::size_t>(col)];
          step(std::span<double>(line));
          for (int row = 0; row < band.height; ++row) plane[static_cast<std::size_t>(row) * static_cast<std::size_t>(band.width) + static_cast<std::size_t>(col)] = line[static_cast<std::size_t>(row)];
        }
      } else {
        for (int row = 0; row < band.height; ++row) step(std::span<double>(plane).subspan(static_cast<std::size_t>(row) * static_cast<std::size_t>(band.width), static_cast<std::size_t>(band.width)));
      }
    }
  }
}

ColourBand cut(const ColourBand& band, int row0, int col0, int height, int width) {
  ColourBand part{width, height, {}};
  for (std::size_t c = 0; c < 3; ++c) {
    for (int row = 0; row < height; ++row) {
      const auto from = band.plane[c].begin() + static_cast<std::ptrdiff_t>(row0 + row) * band.width + col0;
      part.plane[c].insert(part.plane[c].end(), from, from + width);
    }
  }
  return part;
}

void paste(ColourBand& band, const ColourBand& part, int row0, int col0) {
  for (std::size_t c = 0; c < 3; ++c) {
    for (int row = 0; row < part.height; ++row) {
      std::copy_n(part.plane[c].begin() + static_cast<std::ptrdiff_t>(row) * part.width, part.width,
                  band.plane[c].begin() + static_cast<std::ptrdiff_t>(row0 + row) * band.width + col0);
    }
  }
}

}  // namespace

void crf137_forward(std::span<double> x) {
  if (x.size() < 2) return;
  lift(x, 1, 1, -9, 1);    // d += (x[-3] - 9 x[-1] - 9 x[1] + x[3]) / 16
  lift(x, 0, -1, 5, 1);    // s += (-d[-3] + 5 d[-1] + 5 d[1] - d[3]) / 16
  std::vector<double> highs;
  for (std::size_t i = 1; i < x.size(); i += 2) highs.push_back(x[i]);
  for (std::size_t i = 0; i < x.size(); i += 2) x[i / 2] = x[i];
  std::copy(highs.begin(), highs.end(), x.end() - static_cast<std::ptrdiff_t>(highs.size()));
}

void crf137_inverse(std::span<double> x) {
  if (x.size() < 2) return;
  const std::vector<double> parts(x.begin(), x.end());
  const std::size_t lows = x.size() - x.size() / 2;
  for (std::size_t i = 0; i < x.size(); ++i) x[i] = i % 2 == 0 ? parts[i / 2] : parts[lows + i / 2];
  lift(x, 0, -1, 5, -1);
  lift(x, 1, 1, -9, -1);
}

ColourBand colour_band_of(const RgbImage& image) {
  ColourBand band{image.width, image.height, {}};
  for (std::size_t c = 0; c < 3; ++c) {
    band.plane[c].resize(band.size());
    for (std::size_t at = 0; at < band.size(); ++at) band.plane[c][at] = image.rgb[3 * at + c];
  }
  return band;
}

ColourPyramid colour_pyramid(const ColourBand& image, int depth) {
  ColourPyramid pyramid{image.width, image.height, image, {}};
  for (int level = 0; level < depth; ++level) {
    ColourBand& band = pyramid.low;
    over_rows_and_columns(band, false, crf137_forward);
    const int low_h = band.height - band.height / 2, low_w = band.width - band.width / 2;
    pyramid.details.push_back({cut(band, 0, low_w, low_h, band.width - low_w), cut(band, low_h, 0, band.height - low_h, low_w),
                               cut(band, low_h, low_w, band.height - low_h, band.width - low_w)});
    pyramid.low = cut(band, 0, 0, low_h, low_w);
  }
  return pyramid;
}

ColourBand image_of_pyramid(const ColourPyramid& pyramid) {
  ColourBand low = pyramid.low;
  for (std::size_t level = pyramid.details.size(); level-- > 0;) {
    const auto& [hl, lh, hh] = pyramid.details[level];
    ColourBand band{low.width + hl.width, low.height + lh.height, {}};
    for (std::vector<double>& plane : band.plane) plane.resize(band.size());
    paste(band, low, 0, 0);
    paste(band, hl, 0, low.width);
    paste(band, lh, low.height, 0);
    paste(band, hh, low.height, low.width);
    over_rows_and_columns(band, true, crf137_inverse);
    low = std::move(band);
  }
  return low;
}

RgbImage rgb_image_of(const ColourBand& band) {
  RgbImage image{band.width, band.height, std::vector<std::uint8_t>(3 * band.size())};
  for (std::size_t c = 0; c < 3; ++c) {
    for (std::size_t at = 0; at < band.size(); ++at) {
      image.rgb[3 * at + c] = static_cast<std::uint8_t>(std::clamp(std::floor(band.plane[c][at] + 0.5), 0.0, 255.0));
    }
  }
  return image;
}

}  // namespace lodestone
