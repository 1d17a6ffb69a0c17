#include "kernels/texture/segmentation.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <string>

#include "kernels/texture/crf_lifting.h"

namespace lodestone {

namespace {

std::vector<Colour> samples_of(const ColourBand& band) {
  std::vector<Colour> samples(band.size());
  for (std::size_t at = 0; at < samples.size(); ++at) samples[at] = {band.plane[0][at], band.plane[1][at], band.plane[2][at]};
  return samples;
}

// Labels of LL1 that refine those of LL2: a tree, so that classes of one colour in different coarse classes stay apart.
std::vector<std::uint32_t> progressive_labels(const ColourBand& image, const SegmentationOptions& options, std::uint32_t& count) {
  const ColourBand fine = colour_pyramid(image, 1).low;
  const ColourBand coarse = colour_pyramid(fine, 1).low;
  const Clusters top = isodata(samples_of(coarse), options.coarse);
  const std::vector<Colour> colours = samples_of(fine);
  std::vector<std::vector<std::uint32_t>> members(top.centres.size());
  for (int row = 0; row < fine.height; ++row) {
    for (int col = 0; col < fine.width; ++col) {
      const auto parent = static_cast<std::size_t>(row / 2) * static_cast<std::size_t>(coarse.width) + static_cast<std::size_t>(col / 2);
      members[top.labels[parent]].push_back(static_cast<std::uint32_t>(row * fine.width + col));
    }
  }
  std::vector<std::uint32_t> labels(colours.size());
  count = 0;
  for (const std::vector<std::uint32_t>& own : members) {
    std::vector<Colour> samples;
    for (const std::uint32_t at : own) samples.push_back(colours[at]);
    const Clusters parts = isodata(samples, options.refine);
    for (std::size_t i = 0; i < own.size(); ++i) labels[own[i]] = count + parts.labels[i];
    count += static_cast<std::uint32_t>(parts.centres.size());
  }
  return labels;
}

// Per pixel: side of the largest square of its own class whose south-east corner it is.
std::vector<std::uint16_t> own_squares(const std::vector<std::uint32_t>& labels, int width, int height) {
  std::vector<std::uint16_t> side(labels.size(), 1);
  for (int row = 1; row < height; ++row) {
    for (int col = 1; col < width; ++col) {
      const auto at = static_cast<std::size_t>(row) * static_cast<std::size_t>(width) + static_cast<std::size_t>(col), up = at - static_cast<std::size_t>(width);
      if (labels[at] != labels[at - 1] || labels[at] != labels[up] || labels[at] != labels[up - 1]) continue;
      side[at] = static_cast<std::uint16_t>(1 + std::min({side[at - 1], side[up], side[up - 1]}));
    }
  }
  return side;
}

// Merges classes without an own 8 x 8 square, fewest pixels first.
void dissolve_small(std::vector<std::uint32_t>& labels, int width, int height, std::vector<Colour>& means, std::vector<std::size_t>& sizes) {
  std::vector<bool> is_good(means.size(), false);
  const auto test_all = [&] {
    const std::vector<std::uint16_t> side = own_squares(labels, width, height);
    for (std::size_t at = 0; at < labels.size(); ++at) {
      if (side[at] >= kSmallPatternSide) is_good[labels[at]] = true;
    }
  };
  // Members of every class, so that a merge touches only what moves.
  std::vector<std::vector<std::uint32_t>> members(means.size());
  for (std::size_t at = 0; at < labels.size(); ++at) members[labels[at]].push_back(static_cast<std::uint32_t>(at));
  const auto has_square_near = [&](std::uint32_t label, const std::vector<std::uint32_t>& moved) {
    for (const std::uint32_t at : moved) {
      const int row = static_cast<int>(at) / width, col = static_cast<int>(at) % width;
      for (int r0 = std::max(0, row - 7); r0 <= std::min(row, height - 8); ++r0) {
        for (int c0 = std::max(0, col - 7); c0 <= std::min(col, width - 8); ++c0) {
          bool is_own = true;
          for (int r = r0; is_own && r < r0 + 8; ++r) {
            for (int c = c0; is_own && c < c0 + 8; ++c) is_own = labels[static_cast<std::size_t>(r) * static_cast<std::size_t>(width) + static_cast<std::size_t>(c)] == label;
          }
          if (is_own) return true;
        }
      }
    }
    return false;
  };
  test_all();
  for (;;) {
    std::optional<std::size_t> smallest;
    std::size_t alive = 0;
    for (std::size_t k = 0; k < means.size(); ++k) {
      if (sizes[k] == 0) continue;
      ++alive;
      if (!is_good[k] && (!smallest || sizes[k] < sizes[*smallest])) smallest = k;
    }
    if (!smallest || alive == 1) return;
    std::size_t nearest = 0;
    double least = std::numeric_limits<double>::infinity();
    for (std::size_t k = 0; k < means.size(); ++k) {
      if (k == *smallest || sizes[k] == 0) continue;
      double d = 0;
      for (std::size_t c = 0; c < 3; ++c) d += (means[k][c] - means[*smallest][c]) * (means[k][c] - means[*smallest][c]);
      if (d < least) least = d, nearest = k;
    }
    const double wa = static_cast<double>(sizes[nearest]), wb = static_cast<double>(sizes[*smallest]);
    for (std::size_t c = 0; c < 3; ++c) means[nearest][c] = (means[nearest][c] * wa + means[*smallest][c] * wb) / (wa + wb);
    const std::vector<std::uint32_t> moved = std::move(members[*smallest]);
    members[*smallest].clear();
    for (const std::uint32_t at : moved) labels[at] = static_cast<std::uint32_t>(nearest);
    members[nearest].insert(members[nearest].end(), moved.begin(), moved.end());
    sizes[nearest] += sizes[*smallest];
    sizes[*smallest] = 0;
    if (!is_good[nearest]) is_good[nearest] = has_square_near(static_cast<std::uint32_t>(nearest), moved);
  }
}

// The own window whose mean is nearest to the class's, moved to it.
RgbImage pattern_of(const RgbImage& image, const std::vector<std::uint32_t>& labels, const std::vector<std::uint16_t>& own, std::uint32_t label,
                    const Colour& mean, const std::array<std::vector<std::int64_t>, 3>& sums) {
  const auto pitch = static_cast<std::size_t>(image.width) + 1;
  for (const int side : {kPatternSide, kSmallPatternSide}) {
    double least = std::numeric_limits<double>::infinity();
    int best_row = -1, best_col = -1;
    Colour best_mean{};
    for (int row = side - 1; row < image.height; ++row) {
      for (int col = side - 1; col < image.width; ++col) {
        const auto at = static_cast<std::size_t>(row) * static_cast<std::size_t>(image.width) + static_cast<std::size_t>(col);
        if (labels[at] != label || own[at] < side) continue;
        const std::size_t r1 = static_cast<std::size_t>(row) + 1, c1 = static_cast<std::size_t>(col) + 1, s = static_cast<std::size_t>(side);
        Colour here{};
        double d = 0;
        for (std::size_t c = 0; c < 3; ++c) {
          const std::int64_t sum = sums[c][r1 * pitch + c1] - sums[c][(r1 - s) * pitch + c1] - sums[c][r1 * pitch + c1 - s] + sums[c][(r1 - s) * pitch + c1 - s];
          here[c] = static_cast<double>(sum) / (side * side);
          d += (here[c] - mean[c]) * (here[c] - mean[c]);
        }
        if (d < least) least = d, best_row = row - side + 1, best_col = col - side + 1, best_mean = here;
      }
    }
    if (best_row < 0) continue;
    RgbImage pattern{side, side, std::vector<std::uint8_t>(static_cast<std::size_t>(3 * side * side))};
    for (int row = 0; row < side; ++row) {
      for (int col = 0; col < side; ++col) {
        for (std::size_t c = 0; c < 3; ++c) {
          const double moved = image.rgb[image.index(best_row + row, best_col + col) + c] + mean[c] - best_mean[c];
          pattern.rgb[pattern.index(row, col) + c] = static_cast<std::uint8_t>(std::clamp(std::floor(moved + 0.5), 0.0, 255.0));
        }
      }
    }
    return pattern;
  }
  // The only class of an image where none has a square: its mean colour.
  RgbImage plain{kSmallPatternSide, kSmallPatternSide, {}};
  for (int i = 0; i < kSmallPatternSide * kSmallPatternSide; ++i) {
    for (const double value : mean) plain.rgb.push_back(static_cast<std::uint8_t>(std::clamp(std::floor(value + 0.5), 0.0, 255.0)));
  }
  return plain;
}

std::array<std::vector<std::int64_t>, 3> summed(const RgbImage& image) {
  const auto pitch = static_cast<std::size_t>(image.width) + 1;
  std::array<std::vector<std::int64_t>, 3> sums;
  for (std::size_t c = 0; c < 3; ++c) {
    sums[c].assign(pitch * (static_cast<std::size_t>(image.height) + 1), 0);
    for (int row = 0; row < image.height; ++row) {
      std::int64_t line = 0;
      for (int col = 0; col < image.width; ++col) {
        line += image.rgb[image.index(row, col) + c];
        const std::size_t at = (static_cast<std::size_t>(row) + 1) * pitch + static_cast<std::size_t>(col) + 1;
        sums[c][at] = sums[c][at - pitch] + line;
      }
    }
  }
  return sums;
}

}  // namespace

Result<TextureSegmentation> segment_texture(const RgbImage& image, const SegmentationOptions& options) {
  if (image.width < kSmallPatternSide || image.height < kSmallPatternSide || image.rgb.size() != 3 * static_cast<std::size_t>(image.width) * static_cast<std::size_t>(image.height)) {
    return Error{ErrorCode::kInvalidArgument, "texture: an image of at least 8 x 8 pixels with 3 bytes each expected, " + std::to_string(image.width) + " x " +
                                                  std::to_string(image.height) + " with " + std::to_string(image.rgb.size()) + " bytes found"};
  }
  if (std::max(image.width, image.height) > 1 << 13) return Error{ErrorCode::kTooLarge, "texture: at most 8192 pixels a side, " + std::to_string(std::max(image.width, image.height)) + " found"};

  std::uint32_t count = 0;
  const std::vector<std::uint32_t> half = progressive_labels(colour_band_of(image), options, count);
  const int half_width = (image.width + 1) / 2;
  std::vector<std::uint32_t> labels(static_cast<std::size_t>(image.width) * static_cast<std::size_t>(image.height));
  std::vector<Colour> means(count);
  std::vector<std::size_t> sizes(count, 0);
  for (int row = 0; row < image.height; ++row) {
    for (int col = 0; col < image.width; ++col) {
      const std::uint32_t label = half[static_cast<std::size_t>(row / 2 * half_width + col / 2)];
      labels[static_cast<std::size_t>(row) * static_cast<std::size_t>(image.width) + static_cast<std::size_t>(col)] = label;
      ++sizes[label];
      for (std::size_t c = 0; c < 3; ++c) means[label][c] += image.rgb[image.index(row, col) + c];
    }
  }
  for (std::uint32_t k = 0; k < count; ++k) {
    for (double& value : means[k]) value /= static_cast<double>(std::max<std::size_t>(sizes[k], 1));
  }

  TextureSegmentation result{image.width, image.height, {}, {}, {}, 0};
  result.classes_before = static_cast<std::size_t>(std::count_if(sizes.begin(), sizes.end(), [](std::size_t size) { return size > 0; }));
  dissolve_small(labels, image.width, image.height, means, sizes);
  const std::vector<std::uint16_t> own = own_squares(labels, image.width, image.height);
  const std::array<std::vector<std::int64_t>, 3> sums = summed(image);
  std::vector<std::uint32_t> number(count, 0);
  for (std::uint32_t k = 0; k < count; ++k) {
    if (sizes[k] == 0) continue;
    if (result.means.size() == kMaxTextureClasses) return Error{ErrorCode::kTooLarge, "texture: more than 255 classes have an 8 x 8 pattern; raise split_std"};
    number[k] = static_cast<std::uint32_t>(result.means.size());
    result.means.push_back(means[k]);
    result.patterns.push_back(pattern_of(image, labels, own, k, means[k], sums));
  }
  result.classes.resize(labels.size());
  for (std::size_t at = 0; at < labels.size(); ++at) result.classes[at] = static_cast<std::uint8_t>(number[labels[at]]);
  return result;
}

}  // namespace lodestone
