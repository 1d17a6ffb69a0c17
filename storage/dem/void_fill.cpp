#include "storage/dem/void_fill.h"

#include <algorithm>
#include <cmath>

namespace lodestone {
namespace {

constexpr std::int64_t kMaxBlocks = std::int64_t{1} << 20;
constexpr std::int32_t kNone = -1;

// One column of the row scan: the nearest site of that column as seen from the row, a distance of `rows`
// away.
struct Column {
  std::int64_t rows2 = 0;  // squared distance in rows
  std::int32_t column = 0;
  std::int32_t site_row = 0;
};

std::int64_t distance2(const Column& c, std::int64_t x) { return (x - c.column) * (x - c.column) + c.rows2; }

// True if `a` (west of `b`) is the better site for position x: nearer, then lower row, then lower column.
bool is_better(const Column& a, const Column& b, std::int64_t x) {
  const std::int64_t da = distance2(a, x), db = distance2(b, x);
  return da != db ? da < db : a.site_row <= b.site_row;
}

// Last x for which `a` (west of `b`) is the better one. As x grows the difference of the squared distances
// grows linearly.
std::int64_t last_better(const Column& a, const Column& b) {
  const std::int64_t num =
      std::int64_t{b.column} * b.column - std::int64_t{a.column} * a.column + b.rows2 - a.rows2;
  const std::int64_t den = 2 * (std::int64_t{b.column} - a.column);
  std::int64_t x = num >= 0 ? num / den : -((-num + den - 1) / den);
  if (!is_better(a, b, x)) --x;
  return x;
}

// For each row of `rows` [first, last] of a width x height raster of sites: calls use(x, y, site) for every x
// that is no site, site = index of its nearest site within `reach` or kNone. Meijster's two passes with a
// strict order among equals.
template <class Use>
void nearest_sites(const std::vector<std::uint8_t>& is_site, std::int32_t width, std::int32_t height,
                   std::int32_t first_row, std::int32_t last_row, std::int32_t first_column,
                   std::int32_t last_column, std::int64_t reach, const Use& use) {
  const auto w = static_cast<std::size_t>(width);
  const std::int64_t reach2 = reach * reach;
  // Row of the nearest site at or below (larger row) each post of the wanted rows.
  std::vector<std::int32_t> below(w, kNone);
  std::vector<std::int32_t> below_of(w * static_cast<std::size_t>(last_row - first_row + 1));
  for (std::int32_t y = height - 1; y >= first_row; --y) {
    const std::uint8_t* site = &is_site[static_cast<std::size_t>(y) * w];
    for (std::size_t x = 0; x < w; ++x) below[x] = site[x] != 0 ? y : below[x];
    if (y <= last_row)
      std::copy(below.begin(), below.end(),
                below_of.begin() + static_cast<std::ptrdiff_t>(static_cast<std::size_t>(y - first_row) * w));
  }
  std::vector<std::int32_t> above(w, kNone);
  std::vector<Column> hull;
  std::vector<std::int64_t> from;  // hull[k] is the best from x = from[k] on
  for (std::int32_t y = 0; y <= last_row; ++y) {
    const std::uint8_t* site = &is_site[static_cast<std::size_t>(y) * w];
    for (std::size_t x = 0; x < w; ++x) above[x] = site[x] != 0 ? y : above[x];
    if (y < first_row) continue;
    const std::int32_t* under = &below_of[static_cast<std::size_t>(y - first_row) * w];
    hull.clear();
    from.clear();
    for (std::int32_t x = 0; x < width; ++x) {
      const std::int32_t up = above[static_cast<std::size_t>(x)], down = under[x];
      if (up == kNone && down == kNone) continue;
      const bool use_up =
          up != kNone && (down == kNone || y - up <= down - y);  // equal: the lower row number
      const std::int64_t rows = use_up ? y - up : down - y;
      if (rows > reach) continue;
      const Column c{rows * rows, x, use_up ? up : down};
      while (!hull.empty() && !is_better(hull.back(), c, from.back())) {
        hull.pop_back();
        from.pop_back();
      }
      if (hull.empty()) {
        hull.push_back(c);
        from.push_back(0);
      } else if (const std::int64_t start = last_better(hull.back(), c) + 1; start < width) {
        hull.push_back(c);
        from.push_back(std::max<std::int64_t>(start, 0));
      }
    }
    std::size_t k = 0;
    for (std::int32_t x = first_column; x <= last_column; ++x) {
      if (site[x] != 0) continue;
      while (k + 1 < hull.size() && from[k + 1] <= x) ++k;
      const bool is_near = !hull.empty() && distance2(hull[k], x) <= reach2;
      use(x, y,
          is_near ? static_cast<std::int64_t>(hull[k].site_row) * width + hull[k].column
                  : std::int64_t{kNone});
    }
  }
}

}  // namespace

FillBlocks::FillBlocks(const PostWindow& world) : world_(world) {
  const auto blocks = [&](std::int64_t posts) { return ((posts - 1) >> shift_) + 1; };
  while (blocks(world.width()) * blocks(world.height()) > kMaxBlocks) ++shift_;
  across_ = blocks(world.width());
  down_ = blocks(world.height());
  sum_1024_.resize(static_cast<std::size_t>(across_ * down_));
  count_.resize(sum_1024_.size());
}

std::vector<FillBlocks::Part> FillBlocks::sums_of(const PostWindow& grid, const std::vector<float>& heights_m,
                                                  const PostWindow& owned) const {
  std::vector<Part> parts;
  const auto block_start = [&](std::int64_t v, std::int64_t origin) {
    return (((v - origin) >> shift_) << shift_) + origin;
  };
  const std::int64_t side = std::int64_t{1} << shift_;
  for (std::int64_t bj = block_start(owned.j0, world_.j0); bj <= owned.j1; bj += side) {
    for (std::int64_t bi = block_start(owned.i0, world_.i0); bi <= owned.i1; bi += side) {
      Part part;
      double sum_m = 0;
      part.block = static_cast<std::int64_t>(block_of(bi, bj));
      for (std::int64_t j = std::max(bj, owned.j0); j <= std::min(bj + side - 1, owned.j1); ++j) {
        const float* row = &heights_m[static_cast<std::size_t>((j - grid.j0) * grid.width() - grid.i0 +
                                                               std::max(bi, owned.i0))];
        const std::int64_t n = std::min(bi + side - 1, owned.i1) - std::max(bi, owned.i0) + 1;
        for (std::int64_t k = 0; k < n; ++k) {
          if (std::isnan(row[k])) continue;
          sum_m += static_cast<double>(row[k]);
          ++part.count;
        }
      }
      part.sum_1024 = std::llround(sum_m * 1024);
      if (part.count > 0) parts.push_back(part);
    }
  }
  return parts;
}

void FillBlocks::add(const std::vector<Part>& parts) {
  for (const Part& part : parts) {
    sum_1024_[static_cast<std::size_t>(part.block)] += part.sum_1024;
    count_[static_cast<std::size_t>(part.block)] += part.count;
  }
}

void FillBlocks::finish() {
  fill_m_.assign(sum_1024_.size(), 0.0F);
  std::vector<std::uint8_t> is_site(sum_1024_.size());
  for (std::size_t b = 0; b < is_site.size(); ++b) {
    is_site[b] = count_[b] > 0;
    if (is_site[b])
      fill_m_[b] =
          static_cast<float>(static_cast<double>(sum_1024_[b]) / 1024 / static_cast<double>(count_[b]));
  }
  nearest_sites(is_site, static_cast<std::int32_t>(across_), static_cast<std::int32_t>(down_), 0,
                static_cast<std::int32_t>(down_ - 1), 0, static_cast<std::int32_t>(across_ - 1),
                std::int64_t{1} << 25, [&](std::int32_t x, std::int32_t y, std::int64_t site) {
                  if (site != kNone)
                    fill_m_[static_cast<std::size_t>(y * across_ + x)] =
                        fill_m_[static_cast<std::size_t>(site)];
                });
}

void fill_voids(HeightGrid& tile, const HeightGrid& around, const FillBlocks& blocks) {
  if (tile.is_void.empty()) return;
  const auto fill_all = [&](auto&& height_of) {
    for (std::int64_t j = tile.window.j0; j <= tile.window.j1; ++j) {
      for (std::int64_t i = tile.window.i0; i <= tile.window.i1; ++i) {
        if (tile.is_void[tile.index(i, j)] != 0) tile.heights_m[tile.index(i, j)] = height_of(i, j);
      }
    }
  };
  std::vector<std::uint8_t> is_site(around.heights_m.size(), 1);
  if (!around.is_void.empty()) {
    for (std::size_t k = 0; k < is_site.size(); ++k) is_site[k] = around.is_void[k] == 0;
  }
  if (std::find(is_site.begin(), is_site.end(), std::uint8_t{1}) == is_site.end()) {
    fill_all([&](std::int64_t i, std::int64_t j) { return blocks.at(i, j); });
    return;
  }
  const std::int64_t di = tile.window.i0 - around.window.i0, dj = tile.window.j0 - around.window.j0;
  nearest_sites(is_site, static_cast<std::int32_t>(around.window.width()),
                static_cast<std::int32_t>(around.window.height()), static_cast<std::int32_t>(dj),
                static_cast<std::int32_t>(dj + tile.window.height() - 1), static_cast<std::int32_t>(di),
                static_cast<std::int32_t>(di + tile.window.width() - 1), kFillReach,
                [&](std::int32_t x, std::int32_t y, std::int64_t site) {
                  const std::int64_t i = around.window.i0 + x, j = around.window.j0 + y;
                  tile.heights_m[tile.index(i, j)] =
                      site != kNone ? around.heights_m[static_cast<std::size_t>(site)] : blocks.at(i, j);
                });
}

}  // namespace lodestone
