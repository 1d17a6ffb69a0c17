#include "kernels/texture/texture_synthesis.h"

#include <algorithm>
#include <bit>
#include <cassert>
#include <string>

#include "kernels/texture/isodata.h"

namespace lodestone {

namespace {

constexpr std::uint64_t kGamma = 0x9E3779B97F4A7C15ULL;
std::uint64_t mix(std::uint64_t z) {
  z += kGamma;
  z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9ULL;
  z = (z ^ z >> 27) * 0x94D049BB133111EBULL;
  return z ^ z >> 31;
}

constexpr int kJointQuadrant = 4, kSwaps = 50;

// Bands of a pyramid in the order of PyramidClasses.
template <class Pyramid>
auto bands_of(Pyramid& pyramid) {
  std::vector<decltype(&pyramid.low)> bands{&pyramid.low};
  for (std::size_t level = pyramid.details.size(); level-- > 0;) {
    for (auto& band : pyramid.details[level]) bands.push_back(&band);
  }
  return bands;
}

// Splits classes of the parent coefficients by colour; the result numbers (parent class, part).
PyramidClasses::Band refine(const ColourBand& band, const PyramidClasses::Band& parent, int scale, const IsodataOptions& options) {
  PyramidClasses::Band result{band.width, band.height, std::vector<std::uint16_t>(band.size(), 0)};
  const std::uint16_t parents = static_cast<std::uint16_t>(*std::max_element(parent.labels.begin(), parent.labels.end()) + 1);
  std::vector<std::vector<std::size_t>> members(parents);
  for (int row = 0; row < band.height; ++row) {
    for (int col = 0; col < band.width; ++col) {
      members[parent.labels[static_cast<std::size_t>(row / scale * parent.width + col / scale)]].push_back(static_cast<std::size_t>(row * band.width + col));
    }
  }
  std::uint16_t first = 0;
  for (const std::vector<std::size_t>& own : members) {
    std::vector<Colour> samples;
    for (const std::size_t at : own) samples.push_back({band.plane[0][at], band.plane[1][at], band.plane[2][at]});
    const Clusters parts = isodata(samples, options);
    for (std::size_t i = 0; i < own.size(); ++i) result.labels[own[i]] = static_cast<std::uint16_t>(first + parts.labels[i]);
    first = static_cast<std::uint16_t>(first + parts.centres.size());
  }
  return result;
}

// A band or class map repeated 2 x 2.
template <class T>
std::vector<T> doubled(const std::vector<T>& x, int width, int height) {
  std::vector<T> result;
  result.reserve(4 * x.size());
  for (int row = 0; row < 2 * height; ++row) {
    const auto from = x.begin() + static_cast<std::ptrdiff_t>(row % height) * width;
    for (int copy = 0; copy < 2; ++copy) result.insert(result.end(), from, from + width);
  }
  return result;
}

ColourBand permuted(const ColourBand& image, const PyramidClasses& classes, const SynthesisOptions& options, int step, int quadrant) {
  ColourPyramid pyramid = colour_pyramid(image, classes.depth);
  const std::uint64_t key = (static_cast<std::uint64_t>(options.texture_class) * 64 + static_cast<std::uint64_t>(step)) * 8 + static_cast<std::uint64_t>(quadrant);
  permute_pyramid(pyramid, classes, options.seed, key, options.mode);
  return colour_band_of(rgb_image_of(image_of_pyramid(pyramid)));
}

}  // namespace

TextureRandom::TextureRandom(std::span<const std::uint64_t> keys) {
  for (const std::uint64_t key : keys) state_ = mix(state_ ^ key);
}

std::uint64_t TextureRandom::next() {
  const std::uint64_t value = mix(state_);
  state_ += kGamma;
  return value;
}

PyramidClasses classify_pattern(const RgbImage& pattern) {
  PyramidClasses classes;
  classes.depth = std::max(1, static_cast<int>(std::bit_width(static_cast<unsigned>(pattern.width))) - 2);
  const ColourPyramid pyramid = colour_pyramid(colour_band_of(pattern), classes.depth);
  // Classes of a few coefficients each, within a few grey levels: what changes places looks alike.
  const IsodataOptions low{2, 4, 8, 8, 1, 12}, detail{1, 3, 6, 6, 2, 12};
  const std::vector<const ColourBand*> bands = bands_of(pyramid);
  const PyramidClasses::Band one{bands[0]->width, bands[0]->height, std::vector<std::uint16_t>(bands[0]->size(), 0)};
  classes.bands.push_back(refine(*bands[0], one, 1, low));
  for (std::size_t b = 1; b < bands.size(); ++b) {
    const bool is_coarsest = b <= 3;   // its parent is the low band; else the same band one level up
    classes.bands.push_back(refine(*bands[b], is_coarsest ? classes.bands[0] : PyramidClasses::Band(classes.bands[b - 3]), is_coarsest ? 1 : 2, detail));
  }
  return classes;
}

void permute_pyramid(ColourPyramid& pyramid, const PyramidClasses& classes, std::uint64_t seed, std::uint64_t key, PermutationMode mode) {
  const std::vector<ColourBand*> bands = bands_of(pyramid);
  assert(bands.size() == classes.bands.size() && "one class map per band");
  for (std::size_t b = 0; b < bands.size(); ++b) {
    const std::uint64_t level = b == 0 ? classes.depth : classes.depth - (b - 1) / 3, index = b == 0 ? 0 : 1 + (b - 1) % 3;
    TextureRandom random(std::array<std::uint64_t, 4>{seed, key, level, index});
    const std::vector<std::uint16_t>& labels = classes.bands[b].labels;
    std::vector<std::vector<std::uint32_t>> members(static_cast<std::size_t>(*std::max_element(labels.begin(), labels.end())) + 1);
    for (std::size_t at = 0; at < labels.size(); ++at) members[labels[at]].push_back(static_cast<std::uint32_t>(at));
    const auto exchange = [&](std::uint32_t x, std::uint32_t y) {
      for (std::vector<double>& plane : bands[b]->plane) std::swap(plane[x], plane[y]);
    };
    if (mode == PermutationMode::kFull) {
      for (const std::vector<std::uint32_t>& own : members) {
        for (std::size_t i = own.size(); i > 1; --i) exchange(own[i - 1], own[random.below(static_cast<std::uint32_t>(i))]);
      }
    } else {
      for (int swap = 0; swap < kSwaps; ++swap) {
        const std::uint32_t at = random.below(static_cast<std::uint32_t>(labels.size()));
        const std::vector<std::uint32_t>& own = members[labels[at]];
        exchange(at, own[random.below(static_cast<std::uint32_t>(own.size()))]);
      }
    }
  }
}

Result<RgbImage> synthesise_texture(const RgbImage& pattern, int side, const SynthesisOptions& options) {
  const int own = pattern.width;
  if (own != pattern.height || own < 4 || own > 128 || !std::has_single_bit(static_cast<unsigned>(own)) || pattern.rgb.size() != static_cast<std::size_t>(3 * own * own)) {
    return Error{ErrorCode::kInvalidArgument, "texture: a square pattern of 4, 8, .. 128 pixels expected, " + std::to_string(own) + " x " + std::to_string(pattern.height) + " found"};
  }
  if (side > 8192) return Error{ErrorCode::kTooLarge, "texture: at most 8192 pixels a side, " + std::to_string(side) + " asked for"};
  PyramidClasses classes = classify_pattern(pattern);
  ColourBand image = colour_band_of(pattern);
  for (int step = 1; image.width < side; ++step) {
    ColourBand larger{2 * image.width, 2 * image.height, {}};
    for (std::vector<double>& plane : larger.plane) plane.resize(larger.size());
    for (int quadrant = 0; quadrant < 4; ++quadrant) {
      const ColourBand part = permuted(image, classes, options, step, quadrant);
      for (std::size_t c = 0; c < 3; ++c) {
        for (int row = 0; row < part.height; ++row) {
          std::copy_n(part.plane[c].begin() + static_cast<std::ptrdiff_t>(row) * part.width, part.width,
                      larger.plane[c].begin() + static_cast<std::ptrdiff_t>(row + quadrant / 2 * part.height) * larger.width + quadrant % 2 * part.width);
        }
      }
    }
    for (PyramidClasses::Band& band : classes.bands) band = {2 * band.width, 2 * band.height, doubled(band.labels, band.width, band.height)};
    image = permuted(larger, classes, options, step, kJointQuadrant);
  }
  return rgb_image_of(image);
}

Result<RgbImage> render_texture(std::span<const std::uint8_t> classes, int width, int height, std::span<const RgbImage> patterns, int texture_side, std::int64_t row0,
                                std::int64_t col0, std::uint64_t seed, PermutationMode mode) {
  RgbImage image{width, height, std::vector<std::uint8_t>(3 * classes.size())};
  std::vector<RgbImage> textures(patterns.size());
  for (int row = 0; row < height; ++row) {
    for (int col = 0; col < width; ++col) {
      const std::uint8_t k = classes[static_cast<std::size_t>(row) * static_cast<std::size_t>(width) + static_cast<std::size_t>(col)];
      if (k >= patterns.size() || patterns[k].rgb.empty()) return Error{ErrorCode::kInvalidArgument, "texture: class " + std::to_string(k) + " has no pattern; " + std::to_string(patterns.size()) + " are there"};
      RgbImage& texture = textures[k];
      if (texture.rgb.empty()) {
        Result<RgbImage> made = synthesise_texture(patterns[k], texture_side, {seed, k, mode});
        texture = made ? std::move(*made) : patterns[k];
      }
      const std::size_t from = texture.index(static_cast<int>((row0 + row) % texture.height), static_cast<int>((col0 + col) % texture.width));
      std::copy_n(texture.rgb.begin() + static_cast<std::ptrdiff_t>(from), 3, image.rgb.begin() + static_cast<std::ptrdiff_t>(image.index(row, col)));
    }
  }
  return image;
}

}  // namespace lodestone
