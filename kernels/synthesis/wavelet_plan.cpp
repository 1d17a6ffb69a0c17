#include "kernels/synthesis/wavelet_plan.h"

#include <algorithm>
#include <bit>

#include "kernels/shared/ls_wavelet.h"

namespace lodestone {

namespace {

// Largest tile edge in cells, and the range of indices that leaves room for every intermediate.
constexpr int kMaxCells = 4096;
constexpr std::int64_t kMaxIndex = std::int64_t{1} << 52;

Error broken(const std::string& rule, const std::string& found) {
  return {ErrorCode::kInvalidArgument, "wavelet task: " + rule + ", found " + found};
}

// Band t is odd (wavelet) in x for d1, d3 and in y for d2, d3.
bool odd_x(int band) { return band != 1; }
bool odd_y(int band) { return band != 0; }

// Index of the coefficient that stands for i after the mirror at the world's border (posts lo..hi of the coarse level).
std::int64_t mirrored_coefficient(std::int64_t i, std::int64_t lo, std::int64_t hi, bool is_odd) {
  if (!is_odd) return mirrored(i, lo, hi);
  if (i < lo) i = 2 * lo - 1 - i;
  if (i > hi - 1) i = 2 * hi - 1 - i;
  return std::clamp(i, lo, std::max(lo, hi - 1));
}

struct Range {
  std::int64_t first, last;
};

// Coefficients of level base + s along one axis, halo included.
Range coefficients(const WaveletTask& task, int s, bool is_x) {
  const PostWindow w = level_window(task, s);
  const BasisHalo halo = basis_halo(task.basis);
  return is_x ? Range{w.i0 - halo.before, w.i1 + halo.after} : Range{w.j0 - halo.before, w.j1 + halo.after};
}

Range world_range(const WaveletTask& task, int s, bool is_x) {
  const PostWindow w = finer(task.world, s);
  return is_x ? Range{w.i0, w.i1} : Range{w.j0, w.j1};
}

// Map position of coefficient i, in 2^-(s+2) entries: U = X - off 2^(s+1), X the fine index counted from the world's corner.
std::int64_t map_position(std::int64_t i, std::int64_t world_first, int s, bool is_odd) {
  return 2 * (i - world_first) + (is_odd ? 1 - (std::int64_t{1} << (s + 1)) : 0);
}

// Coefficient that column (or row) i of `range` stands for: mirrored at the world's border. Posts outside the world may be
// anything, so indices that would leave the range are clamped to it.
std::int64_t coefficient_of(std::int64_t i, Range range, Range world, bool is_odd) {
  return std::clamp(mirrored_coefficient(std::clamp(i, range.first, range.last), world.first, world.last, is_odd), range.first, range.last);
}

// Entries along one axis that the levels 0..depth-1 read.
Range map_range(const WaveletTask& task, bool is_x, bool is_odd, std::int64_t map_count) {
  Range entries{map_count - 1, 0};
  for (int s = 0; s < task.depth; ++s) {
    const Range range = coefficients(task, s, is_x), world = world_range(task, s, is_x);
    // Inside the world the index grows with i, so the extremes lie at the ends, at the world's border or in the halo.
    std::int64_t lo = coefficient_of(range.first, range, world, is_odd), hi = lo;
    const auto visit = [&](std::int64_t i) {
      const std::int64_t m = coefficient_of(i, range, world, is_odd);
      lo = std::min(lo, m);
      hi = std::max(hi, m);
    };
    for (int n = 0; n < 5; ++n) {
      visit(range.first + n);
      visit(range.last - n);
    }
    visit(world.first);
    visit(world.last);
    visit(world.last - 1);
    const auto entry = [&](std::int64_t i) {
      return std::clamp<std::int64_t>(map_position(i, world.first, s, is_odd) >> (s + 2), 0, map_count - 1);
    };
    entries.first = std::min(entries.first, std::min(entry(lo), std::max<std::int64_t>(map_count - 2, 0)));
    entries.last = std::max(entries.last, std::min(entry(hi) + 1, map_count - 1));
  }
  return entries;
}

std::vector<int> mirror_table(Range range, Range world, bool is_odd, int period, int entries) {
  std::vector<int> table(static_cast<std::size_t>(entries));
  for (int n = 0; n < entries; ++n)
    table[static_cast<std::size_t>(n)] = static_cast<int>(coefficient_of(range.first + n % period, range, world, is_odd) - range.first);
  return table;
}

SigmaPlan plan_map(const WaveletTask& task, int band, const PostWindow& window, std::vector<float>& running, const LevelPlan& level,
                   int s) {
  const SigmaMap& map = task.maps[static_cast<std::size_t>(band)];
  const BandSigma& sigma = task.bands[static_cast<std::size_t>(band)];
  const auto at = [&](std::int64_t i, std::int64_t j) { return static_cast<std::size_t>((j - map.j0) * map.width + (i - map.i0)); };
  SigmaPlan plan;
  plan.width = static_cast<int>(window.width());
  plan.height = static_cast<int>(window.height());
  const std::size_t count = static_cast<std::size_t>(plan.width) * static_cast<std::size_t>(plan.height);
  plan.sigma_m.resize(count);
  // Running power s0 q .. q, one factor more per level.
  const bool is_first = s == 0;
  if (is_first) running.resize(count);
  std::size_t n = 0;
  for (std::int64_t j = window.j0; j <= window.j1; ++j) {
    const std::size_t row = at(window.i0, j);
    for (std::size_t k = 0; k < static_cast<std::size_t>(plan.width); ++k, ++n)
      running[n] = is_first ? map.s0[row + k] : running[n] * map.q[row + k];
  }
  const float kappa = sigma.kappa[static_cast<std::size_t>(s)];
  for (n = 0; n < count; ++n) plan.sigma_m[n] = running[n] * kappa;
  // Columns: the kernel adds twice the relative index; rows: done here.
  const Range columns = coefficients(task, s, true), world_x = world_range(task, s, true);
  plan.u = static_cast<int>(map_position(columns.first, world_x.first, s, odd_x(band)) - (window.i0 << (s + 2)));
  const Range rows = coefficients(task, s, false), world_y = world_range(task, s, false);
  const std::vector<int>& relative = odd_y(band) ? level.rows_odd : level.rows_even;
  const auto u0 = static_cast<int>(map_position(rows.first, world_y.first, s, odd_y(band)) - (window.j0 << (s + 2)));
  plan.row_entry.resize(relative.size());
  plan.row_fraction.resize(relative.size());
  for (std::size_t r = 0; r < relative.size(); ++r)
    plan.row_entry[r] = ls_map_entry(u0 + 2 * relative[r], plan.height, s + 2, task.lookup == SigmaLookup::kNearest, &plan.row_fraction[r]);
  return plan;
}

// User mask and voids as one raster of level max(mask level, 0): value, and a flag for what protects.
struct Pixels {
  int level = 0;
  std::int64_t i0 = 0, j0 = 0;
  int width = 0, height = 0;
  std::vector<std::uint32_t> value;
  std::uint32_t at(std::int64_t i, std::int64_t j) const {
    return value[static_cast<std::size_t>((j - j0) * width + (i - i0))];
  }
};

std::uint8_t pixel(const MaskCrop& crop, std::int64_t i, std::int64_t j) {
  return crop.pixels[static_cast<std::size_t>((j - crop.j0) * crop.width + (i - crop.i0))];
}

Pixels merged_masks(const WaveletTask& task) {
  Pixels out;
  out.level = std::max(task.mask ? task.mask->level : 0, 0);
  const PostWindow window = mask_window(task, out.level);
  out.i0 = window.i0;
  out.j0 = window.j0;
  out.width = static_cast<int>(window.width());
  out.height = static_cast<int>(window.height());
  out.value.reserve(static_cast<std::size_t>(out.width) * static_cast<std::size_t>(out.height));
  const int user_shift = task.mask ? out.level - task.mask->level : 0;
  const bool protects = task.mask_mode == MaskMode::kProtect;
  for (std::int64_t j = window.j0; j <= window.j1; ++j)
    for (std::int64_t i = window.i0; i <= window.i1; ++i) {
      unsigned value = task.mask ? pixel(*task.mask, i >> user_shift, j >> user_shift) : 0u;
      if (value == 255 && protects) value |= LS_MASK_PIXEL_PROTECTS;
      if (task.void_mask && pixel(*task.void_mask, i >> out.level, j >> out.level) == 255) value |= LS_MASK_PIXEL_PROTECTS;
      out.value.push_back(value);
    }
  return out;
}

// One value per fine vertex of `window` (fine indices from the world's corner), for masks finer than the fine level by r levels.
std::vector<std::uint32_t> vertex_values(const Pixels& pixels, const PostWindow& window, int r) {
  std::vector<std::uint32_t> out;
  out.reserve(static_cast<std::size_t>(window.width() * window.height()));
  const std::int64_t half = std::int64_t{1} << (r - 1), whole = std::int64_t{1} << r;
  for (std::int64_t y = window.j0; y <= window.j1; ++y)
    for (std::int64_t x = window.i0; x <= window.i1; ++x) {
      std::uint64_t sum = 0;
      unsigned flags = 0;
      for (std::int64_t j = (y << r) - half; j < (y << r) + half; ++j)
        for (std::int64_t i = (x << r) - half; i < (x << r) + half; ++i) sum += pixels.at(i, j) & LS_MASK_PIXEL_VALUE;
      // Protection counts whole cells: all four around the vertex.
      for (std::int64_t j = (y << r) - whole; j < (y << r) + whole; ++j)
        for (std::int64_t i = (x << r) - whole; i < (x << r) + whole; ++i)
          flags |= pixels.at(i, j) & LS_MASK_PIXEL_PROTECTS;
      const std::uint64_t v = (4 * sum + (std::uint64_t{1} << (2 * r - 1))) >> (2 * r);
      out.push_back(static_cast<std::uint32_t>(v) | flags);
    }
  return out;
}

// A span of columns; empty when begin >= end.
struct Span {
  int begin = 1 << 20, end = 0;
  void add(const Span& other) {
    begin = std::min(begin, other.begin);
    end = std::max(end, other.end);
  }
};

// Columns of coefficients whose filters can meet the non-zero entries of a source row. Mirrored columns lie within eight of the
// ones that they stand for.
Span reached_columns(const MaskPlan& plan, int row) {
  const auto first = plan.source.begin() + std::ptrdiff_t{row} * plan.width, last = first + plan.width;
  const auto is_set = [](std::uint32_t v) { return v != 0; };
  const auto low = std::find_if(first, last, is_set);
  if (low == last) return {};
  const auto high = std::find_if(std::make_reverse_iterator(last), std::make_reverse_iterator(low), is_set).base();
  const auto fine = [&](auto it) { return static_cast<int>((it - first) << plan.shift) - plan.x; };
  return {fine(low) / 2 - 8 - 3, fine(high) / 2 + 8 + 3};
}

MaskRow mask_row(const MaskPlan& plan, const std::vector<Span>& reached, int fine_row, bool is_odd) {
  MaskRow row;
  const int vertices = plan.is_vertices, odd = is_odd;
  const int start = fine_row + ls_mask_first(odd, vertices), n = ls_mask_count(odd, vertices);
  row.first = start >> plan.shift;
  const int count = ((start + n - 1) >> plan.shift) - row.first + 1;
  Span span;
  for (int k = 0; k < count; ++k) span.add(reached[static_cast<std::size_t>(row.first + k)]);
  if (span.begin >= span.end) return row;
  row.count = count;
  row.begin = span.begin;
  row.end = span.end;
  for (int k = 0; k < n; ++k)
    row.weight[static_cast<std::size_t>(((start + k) >> plan.shift) - row.first)] += static_cast<std::uint8_t>(ls_mask_weight(k, odd, vertices));
  return row;
}

MaskPlan plan_mask(const WaveletTask& task, const Pixels& pixels, const LevelPlan& level, int s) {
  MaskPlan plan;
  const Range columns = coefficients(task, s, true), rows = coefficients(task, s, false);
  const Range world_x = world_range(task, s, true), world_y = world_range(task, s, false);
  const int fine = s + 1;
  std::int64_t first_column = 0, first_row = 0;  // of the source, in fine columns and rows
  if (pixels.level <= fine) {
    plan.shift = fine - pixels.level;
    plan.width = pixels.width;
    plan.height = pixels.height;
    plan.source = pixels.value;
    first_column = pixels.i0 << plan.shift;
    first_row = pixels.j0 << plan.shift;
  } else {
    plan.is_vertices = true;
    const auto bounds = [](Range range, Range world) {
      return Range{2 * (range.first - world.first) - 2, 2 * (range.last - world.first) + 3};
    };
    const Range fx = bounds(columns, world_x), fy = bounds(rows, world_y);
    const int r = pixels.level - fine;
    plan.width = static_cast<int>(fx.last - fx.first + 1);
    plan.height = static_cast<int>(fy.last - fy.first + 1);
    plan.source = vertex_values(pixels, {fx.first, fy.first, fx.last, fy.last}, r);
    first_column = fx.first;
    first_row = fy.first;
  }
  plan.x = static_cast<int>(2 * (columns.first - world_x.first) - first_column);
  const auto y = static_cast<int>(2 * (rows.first - world_y.first) - first_row);
  std::vector<Span> reached, read(static_cast<std::size_t>(plan.height));
  for (int row = 0; row < plan.height; ++row) reached.push_back(reached_columns(plan, row));
  const auto make_rows = [&](const std::vector<int>& relative, bool is_odd, std::vector<MaskRow>& rows_out) {
    rows_out.reserve(relative.size());
    for (const int r : relative) {
      const MaskRow row = mask_row(plan, reached, y + 2 * r + is_odd, is_odd);
      for (int k = 0; k < row.count; ++k) read[static_cast<std::size_t>(row.first + k)].add({row.begin, row.end});
      rows_out.push_back(row);
    }
  };
  make_rows(level.rows_odd, true, plan.rows_odd);
  make_rows(level.rows_even, false, plan.rows_even);
  for (const Span& span : read) {
    // Blocks of 16 that touch the span are read whole.
    plan.begin.push_back(span.begin - 16);
    plan.end.push_back(span.end + 16);
  }
  return plan;
}

Result<void> check_crop(const WaveletTask& task, const MaskCrop& crop, const char* name) {
  const PostWindow w = mask_window(task, crop.level);
  if (crop.level < -40 || crop.level > 12) return broken(std::string(name) + " level must be -40..12", std::to_string(crop.level));
  if (crop.width < 1 || crop.height < 1 ||
      crop.pixels.size() != static_cast<std::size_t>(crop.width) * static_cast<std::size_t>(crop.height))
    return broken(std::string(name) + " must have width * height pixels", std::to_string(crop.pixels.size()));
  if (w.i0 < crop.i0 || w.j0 < crop.j0 || w.i1 >= crop.i0 + crop.width || w.j1 >= crop.j0 + crop.height)
    return broken(std::string(name) + " must hold mask_window()",
                  std::to_string(crop.width) + " x " + std::to_string(crop.height) + " pixels from (" + std::to_string(crop.i0) + ", " +
                      std::to_string(crop.j0) + ")");
  return {};
}

}  // namespace

PostWindow level_window(const WaveletTask& task, int s) {
  const int k = task.depth - s, cells = task.posts - 1;
  return {floor_shift(task.x0, k), floor_shift(task.y0, k), ceil_shift(task.x0 + cells, k), ceil_shift(task.y0 + cells, k)};
}

PostWindow coarse_window(const WaveletTask& task) {
  const PostWindow w = level_window(task, 0);
  const int halo = basis_halo(task.basis).coarse;
  return {w.i0 - halo, w.j0 - halo, w.i1 + halo, w.j1 + halo};
}

PostWindow sigma_window(const WaveletTask& task, int band) {
  const SigmaMap& map = task.maps[static_cast<std::size_t>(band)];
  const Range x = map_range(task, true, odd_x(band), map.map_width), y = map_range(task, false, odd_y(band), map.map_height);
  return {x.first, y.first, x.last, y.last};
}

PostWindow mask_window(const WaveletTask& task, int mask_level) {
  const PostWindow w = coarse_window(task);
  // Half data cells: 2.5 cells beyond the region, and what the wider support of kCdf44 reaches.
  const std::int64_t reach = task.basis == WaveletBasis::kCdf22 ? 5 : 9;
  const auto low = [&](std::int64_t half_cells) {
    return mask_level >= 1 ? half_cells << (mask_level - 1) : floor_shift(half_cells, 1 - mask_level);
  };
  const auto high = [&](std::int64_t half_cells) {
    return mask_level >= 1 ? half_cells << (mask_level - 1) : ceil_shift(half_cells, 1 - mask_level);
  };
  return {low(2 * (w.i0 - task.world.i0) - reach), low(2 * (w.j0 - task.world.j0) - reach),
          high(2 * (w.i1 - task.world.i0) + reach) - 1, high(2 * (w.j1 - task.world.j0) + reach) - 1};
}

Result<void> check_task(const WaveletTask& task) {
  const int cells = task.posts - 1;
  if (task.depth < 1 || task.depth > kMaxDepth) return broken("depth must be 1..16", std::to_string(task.depth));
  if (cells < 1 || cells > kMaxCells || !std::has_single_bit(static_cast<unsigned>(cells)))
    return broken("posts must be 2^n + 1, 2..4097", std::to_string(task.posts));
  if (task.x0 % cells != 0 || task.y0 % cells != 0)
    return broken("x0 and y0 must be multiples of posts - 1", std::to_string(task.x0) + ", " + std::to_string(task.y0));
  if (task.world.width() < 2 || task.world.height() < 2)
    return broken("the world must have at least 2 x 2 posts", std::to_string(task.world.width()) + " x " + std::to_string(task.world.height()));
  if (task.base_level < 0 || task.base_level + task.depth > 255) return broken("levels must be 0..255", std::to_string(task.base_level));
  const PostWindow fine = finer(task.world, task.depth);
  for (const std::int64_t index : {task.x0, task.y0, fine.i0, fine.j0, fine.i1, fine.j1})
    if (index > kMaxIndex || index < -kMaxIndex) return broken("indices must lie within 2^52", std::to_string(index));
  if (task.x0 > fine.i1 || task.y0 > fine.j1 || task.x0 + cells < fine.i0 || task.y0 + cells < fine.j0)
    return broken("the tile must touch the world", std::to_string(task.x0) + ", " + std::to_string(task.y0));
  const PostWindow coarse = coarse_window(task);
  if (task.coarse_m.size() != static_cast<std::size_t>(coarse.width() * coarse.height()))
    return broken("coarse_m must hold coarse_window(), " + std::to_string(coarse.width() * coarse.height()) + " heights",
                  std::to_string(task.coarse_m.size()));
  if (task.method == WaveletMethod::kLsa) {
    for (int band = 0; band < 3; ++band) {
      const SigmaMap& map = task.maps[static_cast<std::size_t>(band)];
      const std::string name = "map of band " + std::to_string(band + 1);
      const std::size_t count = static_cast<std::size_t>(std::max(map.width, 0)) * static_cast<std::size_t>(std::max(map.height, 0));
      if (map.map_width < 1 || map.map_height < 1 || map.s0.size() != count || map.q.size() != count)
        return broken(name + " must have width * height entries of s0 and q", std::to_string(map.s0.size()) + " and " + std::to_string(map.q.size()));
      const PostWindow w = sigma_window(task, band);
      if (w.i0 < map.i0 || w.j0 < map.j0 || w.i1 >= map.i0 + map.width || w.j1 >= map.j0 + map.height)
        return broken(name + " must hold sigma_window()", std::to_string(map.width) + " x " + std::to_string(map.height) + " entries from (" +
                                                             std::to_string(map.i0) + ", " + std::to_string(map.j0) + ")");
    }
  }
  if (task.mask)
    if (Result<void> ok = check_crop(task, *task.mask, "mask"); !ok) return ok;
  if (task.void_mask) {
    if (task.void_mask->level != 0) return broken("void_mask level must be 0", std::to_string(task.void_mask->level));
    if (Result<void> ok = check_crop(task, *task.void_mask, "void_mask"); !ok) return ok;
  }
  return {};
}

WaveletPlan plan_task(const WaveletTask& task) {
  WaveletPlan plan;
  plan.method = task.method;
  Pixels pixels;
  if ((task.mask || task.void_mask) && task.method != WaveletMethod::kLinear) {
    pixels = merged_masks(task);
    const auto is_white = [](std::uint32_t v) { return (v & LS_MASK_PIXEL_PROTECTS) || v == 255; };
    if (std::all_of(pixels.value.begin(), pixels.value.end(), is_white)) plan.method = WaveletMethod::kLinear;
    else plan.has_mask = std::any_of(pixels.value.begin(), pixels.value.end(), [](std::uint32_t v) { return v != 0; });
  }
  const BasisHalo halo = basis_halo(task.basis);
  std::array<PostWindow, 3> windows;
  std::array<std::vector<float>, 3> running;
  std::array<float, 3> sigma{task.bands[0].s0, task.bands[1].s0, task.bands[2].s0};
  if (plan.method == WaveletMethod::kLsa)
    for (int band = 0; band < 3; ++band) windows[static_cast<std::size_t>(band)] = sigma_window(task, band);
  for (int s = 0; s < task.depth; ++s) {
    LevelPlan level;
    const PostWindow here = level_window(task, s), next = level_window(task, s + 1);
    level.level = task.base_level + s;
    level.posts = static_cast<int>(here.width()) + 2 * halo.coarse;
    level.columns = static_cast<int>(here.width()) + halo.before + halo.after;
    level.lead = halo.before - halo.coarse;
    level.stride = std::max(level.columns, 16);
    level.crop_x = static_cast<int>(next.i0 - 2 * here.i0);
    level.crop_y = static_cast<int>(next.j0 - 2 * here.j0);
    const Range x = coefficients(task, s, true), y = coefficients(task, s, false);
    level.base_i = static_cast<std::uint32_t>(x.first);
    level.base_j = static_cast<std::uint32_t>(y.first);
    level.map_shift = s + 2;
    if (plan.method != WaveletMethod::kLinear) {
      const Range world_x = world_range(task, s, true), world_y = world_range(task, s, false);
      level.columns_odd = mirror_table(x, world_x, true, level.stride, level.stride + 16);
      level.columns_even = mirror_table(x, world_x, false, level.stride, level.stride + 16);
      level.rows_odd = mirror_table(y, world_y, true, level.columns + 1, level.columns + 1);
      level.rows_even = mirror_table(y, world_y, false, level.columns + 1, level.columns + 1);
    }
    for (std::size_t band = 0; band < 3; ++band) {
      level.sigma_m[band] = sigma[band];
      sigma[band] = sigma[band] * task.bands[band].q;
      if (plan.method == WaveletMethod::kLsa) level.maps[band] = plan_map(task, static_cast<int>(band), windows[band], running[band], level, s);
    }
    if (plan.has_mask) plan.masks.push_back(plan_mask(task, pixels, level, s));
    plan.levels.push_back(std::move(level));
  }
  return plan;
}

}  // namespace lodestone
