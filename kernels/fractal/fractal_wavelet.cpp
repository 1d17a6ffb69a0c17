#include "kernels/fractal/fractal_wavelet.h"

#include <algorithm>
#include <string>

#include "kernels/shared/ls_fractal.h"

namespace lodestone {
namespace {

constexpr int kRing = 2;  // items around the rectangle

Error broken(const std::string& what) { return {ErrorCode::kInvalidArgument, "fractal wavelet: " + what}; }

// Planes over a rectangle of coarse items and a ring around it.
class Transform {
 public:
  // world: all coarse posts.
  Transform(const PostWindow& items, const PostWindow& world, const FractalWaveletOptions& options)
      : options_(options) {
    g_.width = static_cast<int>(items.width()) + 2 * kRing;
    g_.height = static_cast<int>(items.height()) + 2 * kRing;
    g_.pitch = g_.parent_pitch = g_.width;
    const auto local = [](std::int64_t v) {
      return static_cast<int>(std::clamp<std::int64_t>(v, -(1 << 30), 1 << 30));
    };
    g_.lo_i = local(world.i0 - items.i0 + kRing);
    g_.hi_i = local(world.i1 - items.i0 + kRing);
    g_.lo_j = local(world.j0 - items.j0 + kRing);
    g_.hi_j = local(world.j1 - items.j0 + kRing);
    g_.parity = static_cast<int>((items.i0 + items.j0) & 1);
    g_.is_published = options.volume == VolumeRule::kPublished;
    g_.is_near_border = options.border == FractalBorder::kRule;
  }

  using Plane = std::vector<float>;
  Plane plane() const {
    return Plane(static_cast<std::size_t>(g_.width + 2) * static_cast<std::size_t>(g_.height + 2), 0.0F);
  }
  // Element of item (i, j), ring included: from -kRing.
  std::size_t at(std::int64_t i, std::int64_t j) const {
    return static_cast<std::size_t>((j + kRing) * g_.pitch + i + kRing + g_.pitch + 1);
  }

  // Periodic: the ring takes the other side's values.
  void wrap(Plane& p) const {
    if (options_.border != FractalBorder::kPeriodic) return;
    const int w = g_.width - 2 * kRing, h = g_.height - 2 * kRing;
    for (int j = -kRing; j < h + kRing; ++j)
      for (int i = -kRing; i < w + kRing; ++i)
        if (i < 0 || j < 0 || i >= w || j >= h) p[at(i, j)] = p[at((i + w) % w, (j + h) % h)];
  }

  // Does the new point of `band` at item (i, j) exist?
  bool exists(int band, std::int64_t i, std::int64_t j) const {
    if (options_.border == FractalBorder::kPeriodic) return true;
    const std::int64_t x = i + kRing, y = j + kRing;
    return x >= g_.lo_i && x <= g_.hi_i - (band & 1) && y >= g_.lo_j && y <= g_.hi_j - (band >> 1);
  }

  Plane weights(int band, const Plane& delta) const {
    ls_step g = g_;
    g.band = band;
    Plane w = plane();
    each([&](int i, int j) { ls_weight(&g, i, j, base(delta), base(w)); });
    return w;
  }

  Plane moved_posts(const Plane& posts, const Plane& w3) const {
    Plane out = plane();
    each([&](int i, int j) { ls_half1_post(&g_, i, j, base(posts), base(w3), base(out)); });
    return out;
  }
  Plane new_centres(const Plane& posts, const Plane& delta3) const {
    Plane out = plane();
    each([&](int i, int j) { ls_half1_centre(&g_, i, j, base(posts), base(delta3), base(out)); });
    return out;
  }
  void half2_old(const Plane& posts, const Plane& centres, const Plane& w1, const Plane& w2, Plane& posts2,
                 Plane& centres2) const {
    each([&](int i, int j) {
      ls_half2_old(&g_, i, j, base(posts), base(centres), base(w1), base(w2), base(posts2), base(centres2));
    });
  }
  Plane plus(const Plane& a, const Plane& b, float sign) const {
    Plane out(a.size());
    for (std::size_t n = 0; n < a.size(); ++n) out[n] = a[n] + sign * b[n];
    return out;
  }

 private:
  const float* base(const Plane& p) const { return p.data() + g_.pitch + 1; }
  float* base(Plane& p) const { return p.data() + g_.pitch + 1; }
  template <class Function>
  void each(Function function) const {
    for (int j = 0; j < g_.height; ++j)
      for (int i = 0; i < g_.width; ++i) function(i, j);
  }

  ls_step g_{};
  FractalWaveletOptions options_;
};

template <class Function>
void over(const PostWindow& w, Function function) {
  for (std::int64_t j = 0; j < w.height(); ++j)
    for (std::int64_t i = 0; i < w.width(); ++i) function(i, j, static_cast<std::size_t>(j * w.width() + i));
}

// The world of even posts that holds `world`.
PostWindow even_world(const PostWindow& world) {
  return {world.i0 & ~std::int64_t{1}, world.j0 & ~std::int64_t{1}, (world.i1 + 1) & ~std::int64_t{1},
          (world.j1 + 1) & ~std::int64_t{1}};
}

Result<void> check_periodic(const PostWindow& coarse, const FractalWaveletOptions& options) {
  if (options.border == FractalBorder::kPeriodic && ((coarse.width() | coarse.height()) & 1))
    return broken("a periodic grid needs an even number of columns and rows, found " +
                  std::to_string(coarse.width()) + " x " + std::to_string(coarse.height()));
  return {};
}

}  // namespace

Result<HeightGrid> refine(const HeightGrid& coarse, const FractalDetail& detail,
                          const FractalWaveletOptions& options) {
  const PostWindow& w = coarse.window;
  const std::size_t count = static_cast<std::size_t>(w.width() * w.height());
  if (w.is_empty() || coarse.heights_m.size() != count)
    return broken("the coarse grid does not hold its window");
  for (const std::vector<float>& delta : detail.delta_m)
    if (!(detail.coarse == w) || delta.size() != count)
      return broken("the details do not belong to the coarse grid");
  if (Result<void> ok = check_periodic(w, options); !ok) return std::move(ok.error());

  const Transform t(w, w, options);
  Transform::Plane posts = t.plane();
  std::array<Transform::Plane, 3> delta{t.plane(), t.plane(), t.plane()};
  over(w, [&](std::int64_t i, std::int64_t j, std::size_t n) {
    posts[t.at(i, j)] = coarse.heights_m[n];
    for (int band = 1; band <= 3; ++band)
      if (t.exists(band, i, j))
        delta[static_cast<std::size_t>(band - 1)][t.at(i, j)] =
            detail.delta_m[static_cast<std::size_t>(band - 1)][n];
  });
  // half-step 1: cell centres
  Transform::Plane w3 = t.weights(3, delta[2]);
  t.wrap(w3);
  Transform::Plane posts1 = t.moved_posts(posts, w3);
  t.wrap(posts1);
  Transform::Plane centres1 = t.new_centres(posts1, delta[2]);
  // half-step 2: edge middles
  Transform::Plane w1 = t.weights(1, delta[0]), w2 = t.weights(2, delta[1]), posts2 = t.plane(),
                   centres2 = t.plane();
  t.wrap(w1);
  t.wrap(w2);
  t.half2_old(posts1, centres1, w1, w2, posts2, centres2);
  t.wrap(posts2);

  const bool periodic = options.border == FractalBorder::kPeriodic;
  HeightGrid fine;
  fine.window = {2 * w.i0, 2 * w.j0, 2 * w.i1 + periodic, 2 * w.j1 + periodic};
  fine.heights_m.resize(static_cast<std::size_t>(fine.window.width() * fine.window.height()));
  over(fine.window, [&](std::int64_t x, std::int64_t y, std::size_t n) {
    const std::int64_t i = x >> 1, j = y >> 1;
    const std::size_t c = t.at(i, j);
    float& out = fine.heights_m[n];
    if ((x & 1) && (y & 1))
      out = centres2[c];
    else if (x & 1)
      out = (posts2[c] + posts2[t.at(i + 1, j)]) * 0.5F + delta[0][c];
    else if (y & 1)
      out = (posts2[c] + posts2[t.at(i, j + 1)]) * 0.5F + delta[1][c];
    else
      out = posts2[c];
  });
  return fine;
}

PostWindow reduction_window(const PostWindow& coarse, const PostWindow& world) {
  return {std::max(world.i0, 2 * coarse.i0 - 5), std::max(world.j0, 2 * coarse.j0 - 5),
          std::min(world.i1, 2 * coarse.i1 + 5), std::min(world.j1, 2 * coarse.j1 + 5)};
}

Result<FractalReduction> reduce(const HeightGrid& fine, const PostWindow& world, const PostWindow& coarse,
                                const FractalWaveletOptions& options) {
  const bool periodic = options.border == FractalBorder::kPeriodic;
  const PostWindow wide = even_world(world);
  const PostWindow coarse_all = periodic
                                    ? PostWindow{world.i0 >> 1, world.j0 >> 1, world.i1 >> 1, world.j1 >> 1}
                                    : PostWindow{wide.i0 >> 1, wide.j0 >> 1, wide.i1 >> 1, wide.j1 >> 1};
  if (coarse.is_empty() || !coarse_all.contains(coarse.i0, coarse.j0) ||
      !coarse_all.contains(coarse.i1, coarse.j1))
    return broken("the coarse posts lie outside the coarse level");
  const PostWindow reads = reduction_window(coarse, world);
  if (!fine.window.contains(reads.i0, reads.j0) || !fine.window.contains(reads.i1, reads.j1) ||
      fine.heights_m.size() != static_cast<std::size_t>(fine.window.width() * fine.window.height()))
    return broken("the fine grid does not hold reduction_window()");
  if (periodic && !(fine.window == world && coarse == coarse_all))
    return broken("a periodic reduction takes whole levels");
  if (periodic && ((world.i0 | world.j0) & 1)) return broken("a periodic level starts on an even post");
  if (Result<void> ok = check_periodic(coarse, options); !ok) return std::move(ok.error());

  const Transform t(coarse, coarse_all, options);
  // 0 where nothing is known: never used.
  const auto read = [&](std::int64_t x, std::int64_t y) {
    if (periodic) {
      x = world.i0 + ((x - world.i0) % world.width() + world.width()) % world.width();
      y = world.j0 + ((y - world.j0) % world.height() + world.height()) % world.height();
    } else {
      x = mirrored(x, world.i0, world.i1);
      y = mirrored(y, world.j0, world.j1);
    }
    return fine.window.contains(x, y) ? fine.at(x, y) : 0.0F;
  };
  std::array<Transform::Plane, 3> delta{t.plane(), t.plane(), t.plane()};
  Transform::Plane posts2 = t.plane(), centres2 = t.plane();
  for (std::int64_t j = -kRing; j < coarse.height() + kRing; ++j) {
    for (std::int64_t i = -kRing; i < coarse.width() + kRing; ++i) {
      const std::int64_t x = 2 * (coarse.i0 + i), y = 2 * (coarse.j0 + j);
      const std::size_t n = t.at(i, j);
      posts2[n] = read(x, y);
      centres2[n] = read(x + 1, y + 1);
      if (t.exists(1, i, j)) delta[0][n] = read(x + 1, y) - (read(x, y) + read(x + 2, y)) * 0.5F;
      if (t.exists(2, i, j)) delta[1][n] = read(x, y + 1) - (read(x, y) + read(x, y + 2)) * 0.5F;
    }
  }
  // Back over half-step 2: posts1 - moved shares = posts2.
  const Transform::Plane zero = t.plane();
  Transform::Plane given_posts = t.plane(), given_centres = t.plane();
  Transform::Plane w1 = t.weights(1, delta[0]), w2 = t.weights(2, delta[1]);
  t.half2_old(zero, zero, w1, w2, given_posts, given_centres);
  Transform::Plane posts1 = t.plus(posts2, given_posts, -1.0F),
                   centres1 = t.plus(centres2, given_centres, -1.0F);
  t.wrap(posts1);
  t.wrap(centres1);
  // Back over half-step 1.
  const Transform::Plane flat = t.new_centres(posts1, zero);
  for (std::int64_t j = -kRing; j < coarse.height() + kRing; ++j)
    for (std::int64_t i = -kRing; i < coarse.width() + kRing; ++i)
      if (t.exists(3, i, j)) delta[2][t.at(i, j)] = centres1[t.at(i, j)] - flat[t.at(i, j)];
  t.wrap(delta[2]);
  const Transform::Plane given = t.moved_posts(zero, t.weights(3, delta[2]));
  const Transform::Plane posts0 = t.plus(posts1, given, -1.0F);

  FractalReduction out;
  out.coarse.window = out.detail.coarse = coarse;
  const std::size_t count = static_cast<std::size_t>(coarse.width() * coarse.height());
  out.coarse.heights_m.resize(count);
  for (std::vector<float>& d : out.detail.delta_m) d.resize(count);
  over(coarse, [&](std::int64_t i, std::int64_t j, std::size_t n) {
    out.coarse.heights_m[n] = posts0[t.at(i, j)];
    for (std::size_t band = 0; band < 3; ++band) out.detail.delta_m[band][n] = delta[band][t.at(i, j)];
  });
  return out;
}

double surface_volume(const HeightGrid& grid, FractalBorder border) {
  const PostWindow& w = grid.window;
  const int more = border == FractalBorder::kPeriodic ? 1 : 0;
  double six_volumes = 0;
  const auto h = [&](std::int64_t i, std::int64_t j) {
    return static_cast<double>(grid.at(i > w.i1 ? w.i0 : i, j > w.j1 ? w.j0 : j));
  };
  for (std::int64_t j = w.j0; j < w.j1 + more; ++j) {
    for (std::int64_t i = w.i0; i < w.i1 + more; ++i) {
      const double falling = h(i, j) + h(i + 1, j + 1), rising = h(i + 1, j) + h(i, j + 1);
      six_volumes += ((i + j) & 1) ? falling + 2 * rising : 2 * falling + rising;
    }
  }
  return six_volumes / 6;
}

}  // namespace lodestone
