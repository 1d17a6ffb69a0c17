#pragma once
// SPEC-SYNTHESIS 2-4 post by post, in 64-bit indices and without regions, tables or tiles: what tiles are compared with.
// A post asks for the coarse posts and coefficients that it needs, as if the whole level were there.

#include <algorithm>
#include <cmath>
#include <functional>
#include <map>
#include <tuple>
#include <vector>

#include "kernels/shared/ls_random.h"
#include "kernels/synthesis/wavelet_task.h"

namespace lodestone::testing {

// A whole small layer: data, LSA maps, masks as functions of world-relative pixel indices (already mirrored beyond the world).
struct World {
  PostWindow window;
  std::vector<float> heights_m;
  std::array<SigmaMap, 3> maps;
  int mask_level = 0;
  std::vector<std::uint8_t> mask;       // mask_width * mask_height, empty = none
  std::vector<std::uint8_t> void_mask;  // one per data cell, empty = none
  std::int64_t mask_width = 0, mask_height = 0;

  float height(std::int64_t i, std::int64_t j) const {
    return heights_m[static_cast<std::size_t>((mirrored(j, window.j0, window.j1) - window.j0) * window.width() +
                                              mirrored(i, window.i0, window.i1) - window.i0)];
  }
  static std::int64_t mirrored_pixel(std::int64_t p, std::int64_t count) {
    if (p < 0) p = -1 - p;
    if (p >= count) p = 2 * count - 1 - p;
    return std::clamp<std::int64_t>(p, 0, count - 1);
  }
  std::uint8_t mask_at(std::int64_t i, std::int64_t j) const {
    return mask.empty() ? 0 : mask[static_cast<std::size_t>(mirrored_pixel(j, mask_height) * mask_width + mirrored_pixel(i, mask_width))];
  }
  std::uint8_t void_at(std::int64_t i, std::int64_t j) const {
    const std::int64_t w = window.width() - 1, h = window.height() - 1;
    return void_mask.empty() ? 0 : void_mask[static_cast<std::size_t>(mirrored_pixel(j, h) * w + mirrored_pixel(i, w))];
  }
};

// Fills in coarse_m, maps, mask and void_mask of a task whose other fields are set.
inline void crop_world(const World& world, WaveletTask& task) {
  task.world = world.window;
  const PostWindow c = coarse_window(task);
  task.coarse_m.clear();
  for (std::int64_t j = c.j0; j <= c.j1; ++j)
    for (std::int64_t i = c.i0; i <= c.i1; ++i) task.coarse_m.push_back(world.height(i, j));
  for (int band = 0; band < 3; ++band) {
    const SigmaMap& whole = world.maps[static_cast<std::size_t>(band)];
    SigmaMap& crop = task.maps[static_cast<std::size_t>(band)];
    crop = {};
    crop.map_width = whole.map_width;
    crop.map_height = whole.map_height;
    if (task.method != WaveletMethod::kLsa) continue;
    const PostWindow w = sigma_window(task, band);
    crop.i0 = w.i0;
    crop.j0 = w.j0;
    crop.width = static_cast<int>(w.width());
    crop.height = static_cast<int>(w.height());
    for (std::int64_t j = w.j0; j <= w.j1; ++j)
      for (std::int64_t i = w.i0; i <= w.i1; ++i) {
        crop.s0.push_back(whole.s0[static_cast<std::size_t>(j * whole.map_width + i)]);
        crop.q.push_back(whole.q[static_cast<std::size_t>(j * whole.map_width + i)]);
      }
  }
  const auto crop_mask = [&](int level, const auto& at) {
    const PostWindow w = mask_window(task, level);
    MaskCrop crop{level, w.i0, w.j0, static_cast<int>(w.width()), static_cast<int>(w.height()), {}};
    for (std::int64_t j = w.j0; j <= w.j1; ++j)
      for (std::int64_t i = w.i0; i <= w.i1; ++i) crop.pixels.push_back(at(i, j));
    return crop;
  };
  task.mask.reset();
  task.void_mask.reset();
  if (!world.mask.empty()) task.mask = crop_mask(world.mask_level, [&](std::int64_t i, std::int64_t j) { return world.mask_at(i, j); });
  if (!world.void_mask.empty()) task.void_mask = crop_mask(0, [&](std::int64_t i, std::int64_t j) { return world.void_at(i, j); });
}

// Heights of any post of the levels base..base + depth of `task`'s recipe over `world`.
class Reference {
 public:
  Reference(const World& world, const WaveletTask& task) : world_(world), task_(task) {}

  // Level base + s, global indices; posts outside the world are mirrored.
  float height(int s, std::int64_t i, std::int64_t j) {
    const PostWindow w = finer(world_.window, s);
    i = mirrored(i, w.i0, w.i1);
    j = mirrored(j, w.j0, w.j1);
    if (s == 0) return world_.height(i, j);
    const auto [it, is_new] = heights_.try_emplace({s, i, j}, 0.0f);
    if (!is_new) return it->second;
    // Columns first, then rows.
    const auto lo = [&, s](std::int64_t column) {
      return line(j, [&](std::int64_t n) { return height(s - 1, column, n); }, [&](std::int64_t n) { return detail(s - 1, 1, column, n); });
    };
    const auto hx = [&, s](std::int64_t column) {
      return line(j, [&](std::int64_t n) { return detail(s - 1, 0, column, n); }, [&](std::int64_t n) { return detail(s - 1, 2, column, n); });
    };
    const float value = line(i, lo, hx);
    heights_[{s, i, j}] = value;
    return value;
  }

  // Mask sum S of 4.1 and whether 4.3 drops the coefficient, both from the definitions.
  std::int64_t removed(int s, int band, std::int64_t i, std::int64_t j) const {
    const std::int64_t x = fine_x(s, band, i), y = fine_y(s, band, j);
    static constexpr int kWavelet[5] = {1, 4, 36, 4, 1}, kScaling[5] = {0, 1, 4, 1, 0};
    std::int64_t sum = 0;
    for (int dy = -2; dy <= 2; ++dy)
      for (int dx = -2; dx <= 2; ++dx) {
        const int weight = (band != 1 ? kWavelet : kScaling)[dx + 2] * (band != 0 ? kWavelet : kScaling)[dy + 2];
        if (weight != 0) sum += weight * vertex(s + 1, x + dx, y + dy);
      }
    return sum;
  }
  bool is_protected(int s, int band, std::int64_t i, std::int64_t j) const {
    const std::int64_t x = fine_x(s, band, i), y = fine_y(s, band, j);
    const int reach_x = band != 1 ? 3 : 2, reach_y = band != 0 ? 3 : 2;
    const auto meets = [&](int level, const auto& at) {
      // Finest common grid: one unit is a pixel or a fine cell, whichever is smaller.
      const int up = std::max(level - (s + 1), 0), down = std::max(s + 1 - level, 0);
      for (std::int64_t v = (y - reach_y) << up; v < (y + reach_y) << up; ++v)
        for (std::int64_t u = (x - reach_x) << up; u < (x + reach_x) << up; ++u)
          if (at(u >> down, v >> down) == 255) return true;
      return false;
    };
    if (task_.mask_mode == MaskMode::kProtect && !world_.mask.empty() &&
        meets(world_.mask_level, [&](std::int64_t u, std::int64_t v) { return world_.mask_at(u, v); }))
      return true;
    return !world_.void_mask.empty() && meets(0, [&](std::int64_t u, std::int64_t v) { return world_.void_at(u, v); });
  }

  float detail(int s, int band, std::int64_t i, std::int64_t j) {
    const PostWindow w = finer(world_.window, s);
    i = band != 1 ? mirrored_odd(i, w.i0, w.i1) : mirrored(i, w.i0, w.i1);
    j = band != 0 ? mirrored_odd(j, w.j0, w.j1) : mirrored(j, w.j0, w.j1);
    if (task_.method == WaveletMethod::kLinear) return 0.0f;
    const auto [it, is_new] = details_.try_emplace({s, band, i, j}, 0.0f);
    if (is_new) it->second = fresh_detail(s, band, i, j);
    return it->second;
  }

 private:
  static std::int64_t mirrored_odd(std::int64_t i, std::int64_t lo, std::int64_t hi) {
    if (i < lo) i = 2 * lo - 1 - i;
    if (i > hi - 1) i = 2 * hi - 1 - i;
    return std::clamp(i, lo, hi - 1);
  }
  std::int64_t fine_x(int s, int band, std::int64_t i) const { return 2 * (i - (world_.window.i0 << s)) + (band != 1); }
  std::int64_t fine_y(int s, int band, std::int64_t j) const { return 2 * (j - (world_.window.j0 << s)) + (band != 0); }

  // v(p) of 4.1 at fine level lev, from the world's corner.
  std::int64_t vertex(int lev, std::int64_t x, std::int64_t y) const {
    const int mu = world_.mask_level;
    std::int64_t sum = 0;
    if (mu <= lev) {
      for (const std::int64_t j : {(y - 1) >> (lev - mu), y >> (lev - mu)})
        for (const std::int64_t i : {(x - 1) >> (lev - mu), x >> (lev - mu)}) sum += world_.mask_at(i, j);
      return sum;
    }
    const int r = mu - lev;
    const std::int64_t half = std::int64_t{1} << (r - 1);
    for (std::int64_t j = (y << r) - half; j < (y << r) + half; ++j)
      for (std::int64_t i = (x << r) - half; i < (x << r) + half; ++i) sum += world_.mask_at(i, j);
    return (4 * sum + (std::int64_t{1} << (2 * r - 1))) >> (2 * r);
  }

  float sigma(int s, int band, std::int64_t i, std::int64_t j) const {
    const BandSigma& b = task_.bands[static_cast<std::size_t>(band)];
    if (task_.method == WaveletMethod::kGsa) {
      float sigma = b.s0;
      for (int n = 0; n < s; ++n) sigma = sigma * b.q;
      return sigma;
    }
    const SigmaMap& map = world_.maps[static_cast<std::size_t>(band)];
    const auto at = [&](std::int64_t u, std::int64_t v) {
      const auto n = static_cast<std::size_t>(v * map.map_width + u);
      float value = map.s0[n];
      for (int k = 0; k < s; ++k) value = value * map.q[n];
      return value * b.kappa[static_cast<std::size_t>(s)];
    };
    const auto place = [s](std::int64_t x, bool is_odd, std::int64_t count) {
      const double u = (static_cast<double>(x) / std::exp2(s + 1) - is_odd) / 2;
      return std::clamp(u, 0.0, static_cast<double>(count - 1));
    };
    const double u = place(fine_x(s, band, i), band != 1, map.map_width), v = place(fine_y(s, band, j), band != 0, map.map_height);
    if (task_.lookup == SigmaLookup::kNearest) return at(static_cast<std::int64_t>(std::floor(u + 0.5)), static_cast<std::int64_t>(std::floor(v + 0.5)));
    const auto cell = [](double x, std::int64_t count) {
      return std::max<std::int64_t>(std::min(static_cast<std::int64_t>(std::floor(x)), count - 2), 0);
    };
    const std::int64_t a = cell(u, map.map_width), b0 = cell(v, map.map_height);
    const std::int64_t a1 = std::min(a + 1, map.map_width - 1), b1 = std::min(b0 + 1, map.map_height - 1);
    const auto f = static_cast<float>(u - static_cast<double>(a)), fv = static_cast<float>(v - static_cast<double>(b0));
    const float a00 = at(a, b0), a10 = at(a1, b0), a01 = at(a, b1), a11 = at(a1, b1);
    const float top = a00 + f * (a10 - a00), bot = a01 + f * (a11 - a01);
    return top + fv * (bot - top);
  }

  float fresh_detail(int s, int band, std::int64_t i, std::int64_t j) const {
    const bool has_mask = !world_.mask.empty();
    const std::int64_t full = 1020 * (band == 2 ? 2116 : 276), s_mask = has_mask ? removed(s, band, i, j) : 0;
    if (s_mask == full || is_protected(s, band, i, j)) return 0.0f;
    const ls_words words = ls_philox(static_cast<std::uint32_t>(i), static_cast<std::uint32_t>(j),
                                     static_cast<std::uint32_t>(task_.base_level + s) | static_cast<std::uint32_t>(band + 1) << 8 | 1u << 16, 0,
                                     static_cast<std::uint32_t>(task_.seed), static_cast<std::uint32_t>(task_.seed >> 32));
    const float d = sigma(s, band, i, j) * ls_gaussian_from_words(words);
    return d * std::sqrt(static_cast<float>(full - s_mask) / static_cast<float>(full));
  }

  template <class C, class D>
  float line(std::int64_t n, const C& c, const D& d) {
    const std::int64_t i = n >> 1;
    if (task_.basis == WaveletBasis::kCdf22) {
      const auto even = [&](std::int64_t k) { return c(k) - (d(k - 1) + d(k)) * 0.25f; };
      return n % 2 == 0 ? even(i) : d(i) + (even(i) + even(i + 1)) * 0.5f;
    }
    const auto s = [&](std::int64_t k) {
      const float near = (d(k - 1) * 2.0f + d(k) * 2.0f) * (29.0f / 128.0f), far = (d(k - 2) * 2.0f + d(k + 1) * 2.0f) * (5.0f / 128.0f);
      return c(k) * 0.5f - (near - far);
    };
    const auto odd = [&](std::int64_t k) { return d(k) * 2.0f + (s(k) + s(k + 1)); };
    return n % 2 == 0 ? s(i) + (odd(i - 1) + odd(i)) * 0.25f : odd(i);
  }

  const World& world_;
  const WaveletTask& task_;
  std::map<std::tuple<int, std::int64_t, std::int64_t>, float> heights_;
  std::map<std::tuple<int, int, std::int64_t, std::int64_t>, float> details_;
};

// A bumpy world with lively maps; deterministic in `rng_seed`.
inline World make_world(std::int64_t i0, std::int64_t j0, int width, int height, std::uint32_t rng_seed) {
  World world;
  world.window = {i0, j0, i0 + width - 1, j0 + height - 1};
  std::uint32_t n = 0;
  const auto uniform = [&] { return static_cast<float>(ls_philox(n++, 0, 0, 0, rng_seed, 77).w0 >> 8) * (1.0f / 16777216.0f); };
  for (int k = 0; k < width * height; ++k) world.heights_m.push_back(800.0f * uniform() - 100.0f);
  for (int band = 0; band < 3; ++band) {
    SigmaMap& map = world.maps[static_cast<std::size_t>(band)];
    map.map_width = map.width = std::max(band != 1 ? width / 2 : (width + 1) / 2, 1);
    map.map_height = map.height = std::max(band != 0 ? height / 2 : (height + 1) / 2, 1);
    for (int k = 0; k < map.width * map.height; ++k) {
      map.s0.push_back(20.0f * uniform());
      map.q.push_back(0.3f + 0.6f * uniform());
    }
  }
  return world;
}

inline void add_mask(World& world, int level, std::uint32_t rng_seed, int kind) {
  const auto pixels = [level](std::int64_t cells) { return level >= 0 ? cells << level : ceil_shift(cells, -level); };
  world.mask_level = level;
  world.mask_width = pixels(world.window.width() - 1);
  world.mask_height = pixels(world.window.height() - 1);
  world.mask.clear();
  for (std::int64_t j = 0; j < world.mask_height; ++j)
    for (std::int64_t i = 0; i < world.mask_width; ++i) {
      const ls_words w = ls_philox(static_cast<std::uint32_t>(i >> std::max(level - 1, 0)), static_cast<std::uint32_t>(j >> std::max(level - 1, 0)), 0, 0, rng_seed, 78);
      // kind 0: noise; 1: sparse white; 2: mostly white; else one gray.
      const std::uint32_t value = kind == 0 ? (w.w0 % 3 == 0 ? 255u : w.w0 >> 24) : kind == 1 ? (w.w0 % 7 == 0 ? 255u : 0u) : kind == 2 ? (w.w0 % 9 == 0 ? 0u : 255u) : static_cast<std::uint32_t>(kind);
      world.mask.push_back(static_cast<std::uint8_t>(value));
    }
}

inline void add_voids(World& world, std::uint32_t rng_seed) {
  world.void_mask.clear();
  for (std::int64_t n = 0; n < (world.window.width() - 1) * (world.window.height() - 1); ++n)
    world.void_mask.push_back(ls_philox(static_cast<std::uint32_t>(n), 1, 0, 0, rng_seed, 79).w0 % 13 == 0 ? 255 : 0);
}

inline std::array<BandSigma, 3> lively_bands() {
  std::array<BandSigma, 3> bands;
  for (std::size_t band = 0; band < 3; ++band) {
    bands[band].s0 = 9.5f - 2.25f * static_cast<float>(band);
    bands[band].q = 0.61f + 0.05f * static_cast<float>(band);
    for (std::size_t s = 0; s < kMaxDepth; ++s) bands[band].kappa[s] = 0.93f + 0.01f * static_cast<float>(s + band);
  }
  return bands;
}

}  // namespace lodestone::testing
