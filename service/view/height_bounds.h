#pragma once
// HeightBounds: between which heights and slopes the ground of a tile lies, with everything that may be drawn below it. View
// selection leaves nothing visible out because of these.

#include <array>
#include <list>
#include <map>
#include <memory>
#include <mutex>
#include <string>

#include "kernels/synthesis/wavelet_task.h"
#include "service/config/recipe.h"
#include "service/ground/layer.h"

namespace lodestone {

// Heights in metres, and height differences per base cell eastwards and southwards, of all triangles of a surface.
struct GroundRange {
  float low_m = 0, high_m = 0;
  float east_min = 0, east_max = 0, south_min = 0, south_max = 0;
};
GroundRange joined(const GroundRange& a, const GroundRange& b);

// Standard deviation that synthetic level base + 1 + n adds to a height, metres, at most anywhere on a base tile.
using DetailLaw = std::array<float, kMaxDepth>;

// A detail is a Gaussian with the hard bound of kGaussianBound standard deviations; the sum of a post's details is given the
// same factor over the root of the sum of their variances.
inline constexpr double kGaussianBound = 6.57;

// Of one layer. Thread-safe; what was read once is kept: 24 bytes per tile of the real levels and 64 per base tile and recipe.
class HeightBounds {
 public:
  explicit HeightBounds(std::shared_ptr<const Layer> layer) : layer_(std::move(layer)) {}

  const Layer& layer() const { return *layer_; }

  // Range of a tile of levels 0..base, joined with those of its descendants down to the base level. The first call reads the
  // layer once, all levels. Errors: those of read_window.
  Result<GroundRange> real(const TileId& id) const;

  // Range of the base level's surface below tile `id` of a synthetic level, as the recipe interpolates it without detail.
  Result<GroundRange> smooth(const TileId& id, const Recipe& recipe) const;

  // The law of base tile (x, y). Errors: those of read_window and of the roughness model.
  Result<DetailLaw> detail(std::int64_t x, std::int64_t y, const Recipe& recipe) const;

  // Bilinear height of the base level at base post (i, j), fractional, clamped to the data.
  Result<double> base_height_m(double i, double j) const;

 private:
  Result<void> read_all() const;  // with mutex_ held
  Result<DetailLaw> compute_detail(std::int64_t x, std::int64_t y, const Recipe& recipe) const;

  const std::shared_ptr<const Layer> layer_;
  mutable std::mutex mutex_;  // guards all below
  mutable std::map<TileId, GroundRange> real_;
  mutable std::map<std::string, std::map<std::array<std::int64_t, 2>, DetailLaw>> details_;
};

// The bounds of the layers that were looked at last. Thread-safe.
class HeightBoundsCache {
 public:
  std::shared_ptr<const HeightBounds> of(const std::shared_ptr<const Layer>& layer);

 private:
  static constexpr std::size_t kMost = 8;
  std::mutex mutex_;  // guards recent_
  std::list<std::shared_ptr<const HeightBounds>> recent_;
};

}  // namespace lodestone
