#include "kernels/mesh/bitree.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <limits>
#include <string>

#include "kernels/mesh/bitree_lattice.h"
#include "kernels/mesh/bitree_select.h"

namespace lodestone {

namespace {

Error invalid(std::string message) { return {ErrorCode::kInvalidArgument, std::move(message)}; }

Result<void> check(const BitreeRequest& request) {
  const PostField& field = request.field;
  const std::int32_t side = field.cols;
  if (field.rows != side || side < 3 || !std::has_single_bit(static_cast<std::uint32_t>(side - 1))) {
    return invalid("bitree: a tile of 2^n + 1 posts a side expected (3, 5, 9, 17, ..), " + std::to_string(field.cols) + " x " +
                   std::to_string(field.rows) + " found; crop or pad it");
  }
  if (side - 1 > 1 << kMaxBitreeN) return Error{ErrorCode::kTooLarge, "bitree: at most 8193 posts a side, " + std::to_string(side) + " found; split the tile"};
  const std::size_t all = static_cast<std::size_t>(side + 2 * field.halo);
  if (field.halo < 0 || field.heights_m.size() != all * all || (!field.is_void.empty() && field.is_void.size() != all * all)) {
    return invalid("bitree: " + std::to_string(all * all) + " heights expected for the tile and its halo, " + std::to_string(field.heights_m.size()) + " found");
  }
  const auto is_tolerance = [](const std::optional<double>& t) { return !t || (std::isfinite(*t) && *t >= 0); };
  if (!request.threshold_m && !request.max_error_m && !request.keeps_all) return invalid("bitree: threshold_m, max_error_m or keeps_all expected, none found");
  if (!is_tolerance(request.threshold_m)) return invalid("bitree: threshold_m must be a finite number >= 0");
  if (!is_tolerance(request.max_error_m)) return invalid("bitree: max_error_m must be a finite number >= 0");
  if (request.wavelet_levels < 1) return invalid("bitree: wavelet_levels must be at least 1, " + std::to_string(request.wavelet_levels) + " found");
  if (!std::isfinite(request.z_step_m) || request.z_step_m <= 0) return invalid("bitree: z_step_m must be a finite number > 0");
  if (!std::isfinite(request.z_offset_m)) return invalid("bitree: z_offset_m must be finite");
  return {};
}

// Lattice heights of the tile. With max_error_m, the lattice must lie that near to every height.
Result<std::vector<std::int32_t>> quantise(const BitreeRequest& request) {
  const PostField& field = request.field;
  std::vector<std::int32_t> q(static_cast<std::size_t>(field.cols) * static_cast<std::size_t>(field.rows));
  double farthest = 0;
  std::size_t at = 0;
  for (int row = 0; row < field.rows; ++row) {
    for (int col = 0; col < field.cols; ++col, ++at) {
      const double height = static_cast<double>(field.at(col, row));
      if (!std::isfinite(height) || field.void_at(col, row)) {
        return invalid("bitree: the post in row " + std::to_string(row) + ", column " + std::to_string(col) + " has no height; fill voids first");
      }
      const double level = std::floor((height - request.z_offset_m) / request.z_step_m + 0.5);
      if (!(std::abs(level) < kMaxLatticeHeight)) {
        return Error{ErrorCode::kTooLarge, "bitree: height " + std::to_string(height) + " m is " + std::to_string(level) +
                                               " steps from the offset, below 2^26 expected; take a larger z_step_m"};
      }
      q[at] = static_cast<std::int32_t>(level);
      farthest = std::max(farthest, std::abs(request.z_offset_m + request.z_step_m * level - height));
    }
  }
  if (request.max_error_m && farthest > *request.max_error_m) {
    return invalid("bitree: z_step_m " + std::to_string(request.z_step_m) + " moves heights by up to " + std::to_string(farthest) +
                   " m, more than max_error_m " + std::to_string(*request.max_error_m) + "; take a step of at most twice the bound");
  }
  return q;
}

// Replaces the wavelet rule's choice on the four edges.
void select_edges(const BitreeRequest& request, std::span<const std::int32_t> q, std::vector<std::uint8_t>& kept, int n) {
  const int width = 1 << n, side = width + 1;
  const double tolerance = std::min(request.threshold_m.value_or(std::numeric_limits<double>::infinity()),
                                    request.max_error_m.value_or(std::numeric_limits<double>::infinity()));
  const int stride = request.threshold_m ? 1 << std::min(request.wavelet_levels, n) : width;
  std::vector<double> heights(static_cast<std::size_t>(side)), quantised(heights.size());
  std::vector<std::uint8_t> line(heights.size());
  for (int edge = 0; edge < 4; ++edge) {
    const int fixed = edge % 2 == 0 ? 0 : width;
    const auto place = [&](int k) { return edge < 2 ? std::pair{fixed, k} : std::pair{k, fixed}; };   // (row, col)
    const auto index = [&](int k) { return static_cast<std::size_t>(place(k).first) * static_cast<std::size_t>(side) + static_cast<std::size_t>(place(k).second); };
    for (int k = 0; k <= width; ++k) {
      const auto [row, col] = place(k);
      const auto at = static_cast<std::size_t>(k);
      heights[at] = static_cast<double>(request.field.at(col, row));
      quantised[at] = request.z_offset_m + request.z_step_m * q[index(k)];
      line[at] = k % stride == 0 ? 1 : 0;
    }
    select_edge(heights, quantised, line, tolerance);
    for (int k = 0; k <= width; ++k) kept[index(k)] = line[static_cast<std::size_t>(k)];
  }
}

// One top-down pass: a post that the surface so far misses by more than the bound is kept.
void select_by_error(const BitreeRequest& request, std::span<const std::int32_t> q, std::vector<std::uint8_t>& kept, int n) {
  const int width = 1 << n, side = width + 1;
  std::vector<double> value(q.size());
  const auto quantised = [&](std::size_t at) { return request.z_offset_m + request.z_step_m * q[at]; };
  for (const int row : {0, width}) {
    for (const int col : {0, width}) {
      const std::size_t at = static_cast<std::size_t>(row) * static_cast<std::size_t>(side) + static_cast<std::size_t>(col);
      value[at] = quantised(at);
    }
  }
  for (int level = 0; level < 2 * n; ++level) {
    for_each_split_point(n, level, [&](const SplitPoint& p) {
      const auto at = static_cast<std::size_t>(p.index);
      const double mean = (value[static_cast<std::size_t>(p.end_a)] + value[static_cast<std::size_t>(p.end_b)]) / 2;
      if (std::abs(mean - static_cast<double>(request.field.at(p.col, p.row))) > *request.max_error_m) kept[at] = 1;
      value[at] = kept[at] != 0 ? quantised(at) : mean;
    });
  }
}

void count_states(Bitree& tree) {
  tree.selected = static_cast<std::size_t>(std::count(tree.state.begin(), tree.state.end(), BitreeState::kSelected));
  tree.fictitious = static_cast<std::size_t>(std::count(tree.state.begin(), tree.state.end(), BitreeState::kFictitious));
}

// Surface on the lattice, in steps: exact means of selected heights.
std::vector<double> lattice_surface(const Bitree& tree) {
  std::vector<double> z(tree.state.size());
  const int width = 1 << tree.n;
  for (const int row : {0, width}) {
    for (const int col : {0, width}) z[tree.index(row, col)] = tree.q[tree.index(row, col)];
  }
  for (int level = 0; level < 2 * tree.n; ++level) {
    for_each_split_point(tree.n, level, [&](const SplitPoint& p) {
      const auto at = static_cast<std::size_t>(p.index);
      z[at] = tree.state[at] == BitreeState::kSelected ? tree.q[at] : (z[static_cast<std::size_t>(p.end_a)] + z[static_cast<std::size_t>(p.end_b)]) / 2;
    });
  }
  return z;
}

}  // namespace

void close_bitree(Bitree& tree) {
  std::replace(tree.state.begin(), tree.state.end(), BitreeState::kFictitious, BitreeState::kNone);
  const int width = 1 << tree.n;
  for (const int row : {0, width}) {
    for (const int col : {0, width}) tree.state[tree.index(row, col)] = BitreeState::kSelected;
  }
  const auto call_in = [&](std::int32_t apex) {
    BitreeState& state = tree.state[static_cast<std::size_t>(apex)];
    if (state == BitreeState::kNone) state = BitreeState::kFictitious;
  };
  // Fine to coarse: what is in the mesh needs its apexes there too.
  for (int level = 2 * tree.n - 1; level > 0; --level) {
    for_each_split_point(tree.n, level, [&](const SplitPoint& p) {
      if (tree.state[static_cast<std::size_t>(p.index)] == BitreeState::kNone) return;
      call_in(p.apex_a);
      if (p.apex_b >= 0) call_in(p.apex_b);
    });
  }
  count_states(tree);
}

Result<Bitree> build_bitree(const BitreeRequest& request) {
  if (Result<void> ok = check(request); !ok) return std::move(ok.error());
  Result<std::vector<std::int32_t>> lattice = quantise(request);
  if (!lattice) return std::move(lattice.error());
  std::vector<std::int32_t>& q = *lattice;

  Bitree tree;
  tree.n = std::countr_zero(static_cast<std::uint32_t>(request.field.cols - 1));
  tree.z_offset_m = request.z_offset_m;
  tree.z_step_m = request.z_step_m;
  std::vector<std::uint8_t> kept(q.size(), request.keeps_all ? 1 : 0);
  if (request.threshold_m && !request.keeps_all) kept = select_by_wavelet(q, tree.n, std::min(request.wavelet_levels, tree.n), *request.threshold_m / request.z_step_m);
  if (request.is_edge_shared && !request.keeps_all) select_edges(request, q, kept, tree.n);
  if (request.max_error_m && !request.keeps_all) select_by_error(request, q, kept, tree.n);
  const int width = 1 << tree.n;
  for (const int row : {0, width}) {
    for (const int col : {0, width}) kept[tree.index(row, col)] = 1;
  }

  tree.state.resize(q.size());
  for (std::size_t at = 0; at < q.size(); ++at) {
    tree.state[at] = kept[at] != 0 ? BitreeState::kSelected : BitreeState::kNone;
    if (kept[at] == 0) q[at] = 0;
  }
  tree.q = std::move(q);
  close_bitree(tree);
  return tree;
}

Result<void> promote_fictitious(Bitree& tree, const PostField& field) {
  if (field.cols != tree.side() || field.rows != tree.side()) {
    return invalid("bitree: a field of " + std::to_string(tree.side()) + " posts a side expected, " + std::to_string(field.cols) + " x " + std::to_string(field.rows) + " found");
  }
  for (int row = 0; row < tree.side(); ++row) {
    for (int col = 0; col < tree.side(); ++col) {
      const std::size_t at = tree.index(row, col);
      if (tree.state[at] != BitreeState::kFictitious) continue;
      const double level = std::floor((static_cast<double>(field.at(col, row)) - tree.z_offset_m) / tree.z_step_m + 0.5);
      if (!(std::abs(level) < kMaxLatticeHeight)) return invalid("bitree: a height of the field is off the lattice of the tree");
      tree.state[at] = BitreeState::kSelected;
      tree.q[at] = static_cast<std::int32_t>(level);
    }
  }
  count_states(tree);
  return {};
}

Bitree bitree_prefix(const Bitree& tree, int level) {
  Bitree prefix = tree;
  for (int l = level; l < 2 * tree.n; ++l) {
    for_each_split_point(tree.n, l, [&](const SplitPoint& p) {
      prefix.state[static_cast<std::size_t>(p.index)] = BitreeState::kNone;
      prefix.q[static_cast<std::size_t>(p.index)] = 0;
    });
  }
  count_states(prefix);
  return prefix;
}

std::vector<double> bitree_surface(const Bitree& tree) {
  std::vector<double> z = lattice_surface(tree);
  for (double& height : z) height = tree.z_offset_m + tree.z_step_m * height;
  return z;
}

BitreeError measure_bitree_error(const Bitree& tree, const PostField& field) {
  const std::vector<double> surface = bitree_surface(tree);
  BitreeError error;
  double sum2 = 0, lowest = std::numeric_limits<double>::infinity(), highest = -lowest;
  std::size_t at = 0;
  for (int row = 0; row < tree.side(); ++row) {
    for (int col = 0; col < tree.side(); ++col, ++at) {
      const double height = static_cast<double>(field.at(col, row)), miss = surface[at] - height;
      error.max_m = std::max(error.max_m, std::abs(miss));
      sum2 += miss * miss;
      lowest = std::min(lowest, height);
      highest = std::max(highest, height);
    }
  }
  error.rms_m = std::sqrt(sum2 / static_cast<double>(surface.size()));
  if (highest > lowest) {
    error.max_normalised = error.max_m / (highest - lowest);
    error.rms_normalised = error.rms_m / (highest - lowest);
  }
  return error;
}

std::vector<double> bitree_error_bounds(const Bitree& tree, double final_error_m) {
  // A selected point lifts a tent of this height over its two triangles; the tents of finer points below it follow. At any place there is at
  // most one tent per level, so the distance to the final surface is at most the largest sum along a path of the hierarchy.
  std::vector<double> bounds(static_cast<std::size_t>(2 * tree.n) + 1, final_error_m);
  const std::vector<double> z = lattice_surface(tree);
  std::vector<float> below(tree.state.size(), 0.0F);   // largest sum of the levels finer than the point's own, rounded up
  for (int level = 2 * tree.n - 1; level >= 0; --level) {
    double worst = 0;
    for_each_split_point(tree.n, level, [&](const SplitPoint& p) {
      const auto at = static_cast<std::size_t>(p.index);
      if (tree.state[at] == BitreeState::kNone) return;
      const double tent = std::abs(z[at] - (z[static_cast<std::size_t>(p.end_a)] + z[static_cast<std::size_t>(p.end_b)]) / 2);
      const double sum = tent + static_cast<double>(below[at]);
      worst = std::max(worst, sum);
      float up = static_cast<float>(sum);
      if (static_cast<double>(up) < sum) up = std::nextafter(up, std::numeric_limits<float>::infinity());
      below[static_cast<std::size_t>(p.apex_a)] = std::max(below[static_cast<std::size_t>(p.apex_a)], up);
      if (p.apex_b >= 0) below[static_cast<std::size_t>(p.apex_b)] = std::max(below[static_cast<std::size_t>(p.apex_b)], up);
    });
    bounds[static_cast<std::size_t>(level)] = std::max(final_error_m + worst * tree.z_step_m, bounds[static_cast<std::size_t>(level) + 1]);
  }
  return bounds;
}

}  // namespace lodestone
