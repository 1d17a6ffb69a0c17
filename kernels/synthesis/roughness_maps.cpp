// LSA: local variance of the last real levels around each coefficient of the finest one, and the local power
// law through it. Source: Perez et al. eq. 8; SPEC-SYNTHESIS 3.4. Every entry depends on global positions
// only, so rectangles of a map are its crops.

#include <algorithm>
#include <cassert>
#include <limits>

#include "kernels/synthesis/det_math.h"
#include "kernels/synthesis/roughness.h"

namespace lodestone {
namespace {

constexpr std::size_t kBlock = 64;
constexpr int kMaxLevels = 6;
constexpr double kFlatVariance = 0x1p-40;  // m^2
constexpr double kGammaMin = 0.2, kGammaMax = 4.0;
// Marks among log2 variances.
constexpr double kFlat = -4096, kUnusable = -8192;
constexpr double kAnyMark = -2048;

using Block = std::array<double, kBlock>;

// Inclusive range of indices.
struct Range {
  std::int64_t lo = 0, hi = -1;
  std::int64_t size() const { return hi - lo + 1; }
};

bool odd_x(int band) { return band != 1; }
bool odd_y(int band) { return band != 0; }

// -log2 E of a mean of w^2 squared unit Gaussians, in the logarithm: removes the bias of the window.
double window_bias(int w) { return w == 1 ? 1.832746 : w == 3 ? 0.166208 : w == 5 ? 0.058477 : 0.029643; }

// Coefficients that exist along one direction of a level with fine posts a..b.
Range existing(std::int64_t a, std::int64_t b, bool is_odd) {
  return {ceil_shift(a, 1), floor_shift(is_odd ? b - 1 : b, 1)};
}

// First coefficient of the window of detail level l around map entry `entry` (local), shifted inwards into
// `all`.
std::int64_t window_start(std::int64_t entry, std::int64_t world0, bool is_odd, int l, int w,
                          const Range& all) {
  const std::int64_t x = world0 + 2 * entry + (is_odd ? 1 : 0);
  const std::int64_t centre = is_odd ? x >> l : (x + (std::int64_t{1} << (l - 1))) >> l;
  return std::clamp(centre - w / 2, all.lo, all.hi - w + 1);
}

// Windows of detail level l that a band's entries look at, by their first coefficients; empty if the level is
// too small.
struct WindowStarts {
  Range x, y;
  bool is_usable = false;
};

WindowStarts window_starts(const PostWindow& entries, const PostWindow& world, const PostWindow& level_world,
                           int band, int l, int w) {
  const Range all_x = existing(level_world.i0, level_world.i1, odd_x(band));
  const Range all_y = existing(level_world.j0, level_world.j1, odd_y(band));
  WindowStarts starts;
  if (entries.is_empty() || all_x.size() < w || all_y.size() < w) return starts;
  starts.is_usable = true;
  starts.x = {window_start(entries.i0, world.i0, odd_x(band), l, w, all_x),
              window_start(entries.i1, world.i0, odd_x(band), l, w, all_x)};
  starts.y = {window_start(entries.j0, world.j0, odd_y(band), l, w, all_y),
              window_start(entries.j1, world.j0, odd_y(band), l, w, all_y)};
  return starts;
}

PostWindow clamped_entries(const PostWindow& entries, const std::array<std::int64_t, 2>& size) {
  return {std::max<std::int64_t>(entries.i0, 0), std::max<std::int64_t>(entries.j0, 0),
          std::min(entries.i1, size[0] - 1), std::min(entries.j1, size[1] - 1)};
}

// log2 of the local variance, bias removed, for each window start of a level (or kFlat, kUnusable).
struct LevelLogs {
  int level = 1;  // s = -level
  WindowStarts starts;
  std::vector<double> log2_v;
  const double* row(std::int64_t start_y) const {
    return log2_v.data() + (start_y - starts.y.lo) * starts.x.size();
  }
};

// Sums over w consecutive elements: out[i] = in[i] + .. + in[i + w - 1], left to right. Whole blocks.
template <class T>
void sum_along(const T* in, int w, std::size_t padded, T* out) {
  for (std::size_t from = 0; from < padded; from += kBlock) {
    std::array<T, kBlock> sum;
    for (std::size_t i = 0; i < kBlock; ++i) sum[i] = in[from + i];
    for (int k = 1; k < w; ++k) {
      for (std::size_t i = 0; i < kBlock; ++i) sum[i] += in[from + i + static_cast<std::size_t>(k)];
    }
    for (std::size_t i = 0; i < kBlock; ++i) out[from + i] = sum[i];
  }
}

// The same over w rows, first row first; row y of the ring is at (y % w) * stride.
template <class T>
void sum_rows(const T* ring, std::size_t stride, std::size_t first, int w, std::size_t from,
              std::array<T, kBlock>& sum) {
  sum.fill(T{0});
  for (int k = 0; k < w; ++k) {
    const T* row = ring + (first + static_cast<std::size_t>(k)) % static_cast<std::size_t>(w) * stride + from;
    for (std::size_t i = 0; i < kBlock; ++i) sum[i] += row[i];
  }
}

LevelLogs level_logs(const AnalysisStep& step, int band, int level, const WindowStarts& starts, int w) {
  const auto t = static_cast<std::size_t>(band);
  const PostWindow reads{starts.x.lo, starts.y.lo, starts.x.hi + w - 1, starts.y.hi + w - 1};
  assert(step.coarse.contains(reads.i0, reads.j0) && step.coarse.contains(reads.i1, reads.j1) &&
         "see lsa_needs()");
  const auto nx = static_cast<std::size_t>(starts.x.size());
  const auto columns = static_cast<std::size_t>(reads.width());
  const auto rows = static_cast<std::size_t>(reads.height());
  const std::size_t padded = (nx + kBlock - 1) / kBlock * kBlock;
  const auto first_of = [&](std::size_t r) {
    return static_cast<std::size_t>((reads.j0 + static_cast<std::int64_t>(r) - step.coarse.j0) *
                                        step.coarse.width() +
                                    (reads.i0 - step.coarse.i0));
  };
  const std::vector<std::uint8_t>& voids = step.detail_void[t];
  bool has_voids = false;
  for (std::size_t r = 0; r < rows && !has_voids && !voids.empty(); ++r) {
    const auto* v = voids.data() + first_of(r);
    has_voids = std::any_of(v, v + columns, [](std::uint8_t flag) { return flag != 0; });
  }

  // By number of valid coefficients: the variance is flat up to `flat_sum`, and log2 of a sum becomes that of
  // the mean, unbiased.
  const int all = w * w;
  std::array<double, 50> flat_sum{}, shift{};
  for (int n = 1; n <= all; ++n) {
    flat_sum[static_cast<std::size_t>(n)] = kFlatVariance * n;
    shift[static_cast<std::size_t>(n)] = det::log2(n) - window_bias(w);
  }

  LevelLogs logs{level, starts, std::vector<double>(nx * static_cast<std::size_t>(starts.y.size()))};
  const auto uw = static_cast<std::size_t>(w);
  std::vector<double> square(padded + uw), ring(padded * uw);
  std::vector<int> valid(has_voids ? padded + uw : 0), valid_ring(has_voids ? padded * uw : 0);
  for (std::size_t r = 0; r < rows; ++r) {
    const float* d = step.detail_m[t].data() + first_of(r);
    for (std::size_t i = 0; i < columns; ++i)
      square[i] = static_cast<double>(d[i]) * static_cast<double>(d[i]);
    if (has_voids) {
      const std::uint8_t* v = voids.data() + first_of(r);
      for (std::size_t i = 0; i < columns; ++i) {
        valid[i] = v[i] == 0;
        if (v[i] != 0) square[i] = 0;
      }
      sum_along(valid.data(), w, padded, valid_ring.data() + r % uw * padded);
    }
    sum_along(square.data(), w, padded, ring.data() + r % uw * padded);
    if (r + 1 < uw) continue;
    double* out = logs.log2_v.data() + (r + 1 - uw) * nx;
    for (std::size_t from = 0; from < nx; from += kBlock) {
      Block sum, result;
      sum_rows(ring.data(), padded, r + 1 - uw, w, from, sum);
      if (has_voids) {
        std::array<int, kBlock> count;
        sum_rows(valid_ring.data(), padded, r + 1 - uw, w, from, count);
        for (std::size_t i = 0; i < kBlock; ++i) {
          const auto n = static_cast<std::size_t>(count[i]);
          result[i] = 2 * count[i] < all        ? kUnusable
                      : !(sum[i] > flat_sum[n]) ? kFlat
                                                : det::log2(sum[i]) - shift[n];
        }
      } else {
        const double limit = flat_sum[static_cast<std::size_t>(all)],
                     by = shift[static_cast<std::size_t>(all)];
        for (std::size_t i = 0; i < kBlock; ++i) {
          const double value = det::log2(sum[i] > limit ? sum[i] : limit) - by;
          result[i] = sum[i] > limit ? value : kFlat;
        }
      }
      std::copy_n(result.data(), std::min(kBlock, nx - from), out + from);
    }
  }
  return logs;
}

// The line through one choice of levels, as weights: gamma = trust_slope + slope . L (then clamped), A =
// offset + mean . L - gamma * mean_l.
struct LineRule {
  std::array<double, kMaxLevels> slope{}, mean{};
  double gamma = 0;   // share of the layer's gamma
  double offset = 0;  // A of the layer, where no level is usable
  double mean_l = 0;
  double scale = 1;  // 0: flat
};

LineRule line_rule(std::span<const LevelLogs> levels, unsigned usable, const BandFit& fit, double trust) {
  LineRule rule;
  int n = 0;
  for (std::size_t k = 0; k < levels.size(); ++k) {
    if ((usable >> k & 1U) != 0) rule.mean_l += levels[k].level, ++n;
  }
  rule.gamma = n >= 2 ? (1.0 - trust) * fit.gamma : fit.gamma;
  if (n == 0) {
    rule.offset = fit.a;
    rule.scale = fit.is_flat ? 0.0 : 1.0;
    return rule;
  }
  rule.mean_l /= n;
  double square = 0;
  for (std::size_t k = 0; k < levels.size(); ++k) {
    if ((usable >> k & 1U) == 0) continue;
    rule.mean[k] = 1.0 / n;
    square += (levels[k].level - rule.mean_l) * (levels[k].level - rule.mean_l);
  }
  for (std::size_t k = 0; k < levels.size() && n >= 2; ++k) {
    if ((usable >> k & 1U) != 0) rule.slope[k] = trust * ((levels[k].level - rule.mean_l) / square);
  }
  return rule;
}

// A and gamma of entries whose log2 variances are logs[level][entry]. `rules` by bit set of usable levels.
class LocalLines {
 public:
  LocalLines(std::span<const LevelLogs> levels, const BandFit& fit, double trust) : count_(levels.size()) {
    for (unsigned usable = 0; usable < (1U << count_); ++usable)
      rules_.push_back(line_rule(levels, usable, fit, trust));
  }

  void apply(const std::array<Block, kMaxLevels>& logs, Block& a, Block& gamma, Block& scale) const {
    double lowest = 0;
    for (std::size_t k = 0; k < count_; ++k) {
      for (std::size_t i = 0; i < kBlock; ++i) lowest = logs[k][i] < lowest ? logs[k][i] : lowest;
    }
    if (lowest < kAnyMark) {
      for (std::size_t i = 0; i < kBlock; ++i) apply_one(logs, i, a, gamma, scale);
      return;
    }
    // Same operations in the same order as apply_one.
    const LineRule& rule = rules_.back();
    Block slope, mean;
    slope.fill(rule.gamma);
    mean.fill(rule.offset);
    for (std::size_t k = 0; k < count_; ++k) {
      const double by_slope = rule.slope[k], by_mean = rule.mean[k];
      for (std::size_t i = 0; i < kBlock; ++i) slope[i] += by_slope * logs[k][i];
      for (std::size_t i = 0; i < kBlock; ++i) mean[i] += by_mean * logs[k][i];
    }
    const double mean_l = rule.mean_l;
    for (std::size_t i = 0; i < kBlock; ++i) {
      double g = slope[i];
      g = g < kGammaMin ? kGammaMin : g;
      g = g > kGammaMax ? kGammaMax : g;
      gamma[i] = g;
      a[i] = mean[i] - g * mean_l;
    }
    scale.fill(rule.scale);
  }

 private:
  void apply_one(const std::array<Block, kMaxLevels>& logs, std::size_t i, Block& a, Block& gamma,
                 Block& scale) const {
    unsigned usable = 0;
    bool is_first = true, is_flat = false;
    for (std::size_t k = 0; k < count_; ++k) {
      if (logs[k][i] == kUnusable) continue;
      const bool flat_here = logs[k][i] == kFlat;
      if (is_first) is_flat = flat_here;
      is_first = false;
      if (!flat_here) usable |= 1U << k;
    }
    if (is_flat) usable = 0;
    const LineRule& rule = rules_[usable];
    double slope = rule.gamma, mean = rule.offset;
    for (std::size_t k = 0; k < count_; ++k) {
      if ((usable >> k & 1U) == 0) continue;
      slope += rule.slope[k] * logs[k][i];
      mean += rule.mean[k] * logs[k][i];
    }
    gamma[i] = std::clamp(slope, kGammaMin, kGammaMax);
    a[i] = mean - gamma[i] * rule.mean_l;
    scale[i] = is_flat ? 0.0 : rule.scale;
  }

  std::size_t count_;
  std::vector<LineRule> rules_;
};

SigmaMap band_map(const PostWindow& entries, const PostWindow& world, std::span<const AnalysisStep> steps,
                  int band, const BandFit& fit, const LsaParameters& parameters) {
  const auto size = sigma_map_size(world, band);
  const PostWindow e = clamped_entries(entries, size);
  SigmaMap map;
  map.map_width = size[0];
  map.map_height = size[1];
  map.i0 = e.i0;
  map.j0 = e.j0;
  if (e.is_empty()) return map;
  map.width = static_cast<int>(e.width());
  map.height = static_cast<int>(e.height());

  const int w = parameters.window;
  std::vector<LevelLogs> levels;
  std::vector<PostWindow> level_worlds;
  PostWindow level_world = world;
  for (int l = 1; l <= parameters.levels && static_cast<std::size_t>(l) <= steps.size(); ++l) {
    const WindowStarts starts = window_starts(e, world, level_world, band, l, w);
    if (starts.is_usable) {
      levels.push_back(level_logs(steps[static_cast<std::size_t>(l - 1)], band, l, starts, w));
      level_worlds.push_back(level_world);
    }
    level_world = coarse_world(level_world);
  }

  const auto width = static_cast<std::size_t>(map.width), height = static_cast<std::size_t>(map.height);
  const std::size_t padded = (width + kBlock - 1) / kBlock * kBlock;
  std::vector<std::vector<std::int32_t>> columns(levels.size());
  std::vector<Range> all_rows(levels.size());
  for (std::size_t k = 0; k < levels.size(); ++k) {
    const Range all_x = existing(level_worlds[k].i0, level_worlds[k].i1, odd_x(band));
    all_rows[k] = existing(level_worlds[k].j0, level_worlds[k].j1, odd_y(band));
    for (std::size_t i = 0; i < padded; ++i) {
      const std::int64_t entry = e.i0 + static_cast<std::int64_t>(std::min(i, width - 1));
      columns[k].push_back(static_cast<std::int32_t>(
          window_start(entry, world.i0, odd_x(band), levels[k].level, w, all_x) - levels[k].starts.x.lo));
    }
  }

  map.s0.resize(width * height);
  map.q.resize(width * height);
  const LocalLines lines(levels, fit, parameters.trust);
  std::array<Block, kMaxLevels> logs;
  for (std::size_t j = 0; j < height; ++j) {
    std::array<const double*, kMaxLevels> rows{};
    for (std::size_t k = 0; k < levels.size(); ++k) {
      rows[k] = levels[k].row(window_start(e.j0 + static_cast<std::int64_t>(j), world.j0, odd_y(band),
                                           levels[k].level, w, all_rows[k]));
    }
    for (std::size_t from = 0; from < width; from += kBlock) {
      for (std::size_t k = 0; k < levels.size(); ++k) {
        const std::int32_t* at = columns[k].data() + from;
        for (std::size_t i = 0; i < kBlock; ++i) logs[k][i] = rows[k][at[i]];
      }
      Block a, gamma, scale;
      lines.apply(logs, a, gamma, scale);
      std::array<float, kBlock> s0, q;
      for (std::size_t i = 0; i < kBlock; ++i) s0[i] = static_cast<float>(det::exp2(0.5 * a[i]) * scale[i]);
      for (std::size_t i = 0; i < kBlock; ++i) q[i] = static_cast<float>(det::exp2(-0.5 * gamma[i]));
      const std::size_t n = std::min(kBlock, width - from);
      std::copy_n(s0.data(), n, map.s0.data() + j * width + from);
      std::copy_n(q.data(), n, map.q.data() + j * width + from);
    }
  }
  return map;
}

}  // namespace

std::array<std::int64_t, 2> sigma_map_size(const PostWindow& world, int band) {
  const auto along = [](std::int64_t posts, bool is_odd) { return is_odd ? posts / 2 : (posts + 1) / 2; };
  return {along(world.width(), odd_x(band)), along(world.height(), odd_y(band))};
}

std::vector<PostWindow> lsa_needs(const PostWindow& entries, const PostWindow& world,
                                  const LsaParameters& parameters) {
  std::vector<PostWindow> needs;
  PostWindow level_world = world;
  for (int l = 1; l <= parameters.levels; ++l) {
    constexpr auto kFar = std::numeric_limits<std::int64_t>::max();
    PostWindow need{kFar, kFar, -kFar, -kFar};
    for (int band = 0; band < 3; ++band) {
      const PostWindow e = clamped_entries(entries, sigma_map_size(world, band));
      const WindowStarts starts = window_starts(e, world, level_world, band, l, parameters.window);
      if (!starts.is_usable) continue;
      need.i0 = std::min(need.i0, starts.x.lo);
      need.j0 = std::min(need.j0, starts.y.lo);
      need.i1 = std::max(need.i1, starts.x.hi + parameters.window - 1);
      need.j1 = std::max(need.j1, starts.y.hi + parameters.window - 1);
    }
    if (need.is_empty()) break;
    needs.push_back(need);
    level_world = coarse_world(level_world);
  }
  return needs;
}

std::array<SigmaMap, 3> lsa_maps(const PostWindow& entries, const PostWindow& world,
                                 std::span<const AnalysisStep> steps, std::span<const BandFit, 3> fits,
                                 const LsaParameters& parameters) {
  assert(world.i0 % 2 == 0 && world.j0 % 2 == 0 && "the base level starts on an even post");
  assert(parameters.levels >= 1 && parameters.levels <= kMaxLevels && parameters.window >= 1 &&
         parameters.window <= 7);
  std::array<SigmaMap, 3> maps;
  for (int band = 0; band < 3; ++band) {
    const auto t = static_cast<std::size_t>(band);
    maps[t] = band_map(entries, world, steps, band, fits[t], parameters);
  }
  return maps;
}

}  // namespace lodestone
