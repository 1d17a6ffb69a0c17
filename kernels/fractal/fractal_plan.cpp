#include "kernels/fractal/fractal_plan.h"

#include <algorithm>
#include <cassert>
#include <initializer_list>
#include <tuple>
#include <utility>

#include "kernels/fractal/fractal_windows.h"

namespace lodestone {
namespace {

int round16(std::int64_t n) { return static_cast<int>((n + 15) & ~std::int64_t{15}); }

int local(std::int64_t v) { return static_cast<int>(std::clamp<std::int64_t>(v, -(1 << 30), 1 << 30)); }

// One plane of heights with its place.
struct Plane {
  FractalSlot slot;
  std::int64_t i0, j0;
  int pitch;
  int at(std::int64_t i, std::int64_t j) const { return static_cast<int>((j - j0) * pitch + (i - i0)); }
};

class Planner {
 public:
  explicit Planner(const FractalTask& task) : task_(task), steps_(fractal_steps(task)) {}

  FractalPlan make() {
    Plane plane = lay_data();
    for (int s = 0; s < task_.depth; ++s) {
      begin_step(s, plane);
      switch (task_.method) {
        case FractalMethod::kSquareSquare:
          square_step(s, plane.slot);
          break;
        case FractalMethod::kDiamondSquare:
          diamond_step(plane.slot);
          break;
        case FractalMethod::kFractalWavelet:
          wavelet_step(plane.slot);
          break;
      }
      plane = {other(plane.slot), 2 * items().i0, 2 * items().j0, 2 * base_.pitch};
    }
    if (task_.method == FractalMethod::kSquareSquare) plane = square_posts(plane);
    plan_.out = plane.slot;
    plan_.out_at = static_cast<std::size_t>(plane.at(task_.x0, task_.y0));
    plan_.out_pitch = static_cast<std::size_t>(plane.pitch);
    return std::move(plan_);
  }

 private:
  const PostWindow& items() const { return steps_[static_cast<std::size_t>(s_)].items; }
  static FractalSlot other(FractalSlot slot) { return slot == kSlotHeightsA ? kSlotHeightsB : kSlotHeightsA; }
  void need(FractalSlot slot, std::size_t floats) {
    std::size_t& size = plan_.floats[slot];
    size = std::max(size, floats);
  }

  // The data in its plane; 0 where there is none or none is needed.
  Plane lay_data() {
    const PostWindow& all = steps_.front().needed;
    const PostWindow known = coarse_window(task_);
    const Plane plane{kSlotHeightsA, all.i0, all.j0, static_cast<int>(all.width())};
    plan_.heights.assign(static_cast<std::size_t>(all.width() * all.height()), 0.0F);
    const PostWindow common{std::max(all.i0, known.i0), std::max(all.j0, known.j0),
                            std::min(all.i1, known.i1), std::min(all.j1, known.j1)};
    for (std::int64_t j = common.j0; j <= common.j1 && common.i1 >= common.i0; ++j) {
      const auto from = task_.coarse_m.begin() + (j - known.j0) * known.width() + (common.i0 - known.i0);
      std::copy(from, from + common.width(), plan_.heights.begin() + plane.at(common.i0, j));
    }
    need(kSlotHeightsA, plan_.heights.size());
    return plane;
  }

  void begin_step(int s, const Plane& parent) {
    s_ = s;
    const FractalParameters& p = task_.parameters;
    const PostWindow& w = items();
    const bool cells = task_.method == FractalMethod::kSquareSquare && s > 0;
    ls_step g{};
    g.width = static_cast<int>(w.width());
    g.height = static_cast<int>(w.height());
    g.pitch = round16(w.width());
    g.parent_at = parent.at(w.i0, w.j0);
    g.parent_pitch = parent.pitch;
    g.lo_i = local((task_.world.i0 << s) - w.i0);
    g.lo_j = local((task_.world.j0 << s) - w.j0);
    g.hi_i = local((task_.world.i1 << s) - (cells ? 1 : 0) - w.i0);
    g.hi_j = local((task_.world.j1 << s) - (cells ? 1 : 0) - w.j0);
    g.parity = static_cast<int>((w.i0 + w.j0) & 1);
    g.node_smooth = p.lookup == NodeLookup::kSmooth;
    g.nodes_x = static_cast<int>(task_.nodes.layer_width);
    g.nodes_y = static_cast<int>(task_.nodes.layer_height);
    g.crop_x = static_cast<int>(task_.nodes.i0);
    g.crop_y = static_cast<int>(task_.nodes.j0);
    g.crop_w = task_.nodes.width;
    g.crop_h = task_.nodes.height;
    g.k0 = static_cast<ls_uint>(task_.seed);
    g.k1 = static_cast<ls_uint>(task_.seed >> 32);
    g.is_published = p.volume == VolumeRule::kPublished;
    // theta looks one item further than an item's own cell
    g.is_near_border = g.lo_i >= -2 || g.lo_j >= -2 || g.hi_i <= g.width + 2 || g.hi_j <= g.height + 2;
    if (p.altitude) {
      g.has_altitude = 1;
      g.altitude_z0 = p.altitude->z0_m;
      g.altitude_scale = 1.0F / (p.altitude->z1_m - p.altitude->z0_m);
      g.altitude_lo = p.altitude->lo;
      g.altitude_span = p.altitude->hi - p.altitude->lo;
    }
    g.has_cap = p.cap_m.has_value();
    g.cap_m = p.cap_m.value_or(0.0F);
    g.has_erosion = p.erosion;
    g.has_water = p.water_m.has_value();
    g.water_m = p.water_m.value_or(0.0F);
    base_ = g;
    need(other(parent.slot), static_cast<std::size_t>(4 * g.pitch) * static_cast<std::size_t>(g.height));
  }

  void add(FractalKernel kernel, const ls_step& g, std::initializer_list<FractalSlot> slots) {
    FractalOp op{kernel, g.width, g.height, g, {}, static_cast<int>(slots.size())};
    std::copy(slots.begin(), slots.end(), op.slots.begin());
    plan_.ops.push_back(op);
  }

  // Step of one band's displacements.
  ls_step band_step(int band) {
    ls_step g = base_;
    const PostWindow& w = items();
    const BandPlace place = band_place(task_, steps_[static_cast<std::size_t>(s_)], s_, band);
    g.band = band;
    g.node_shift = place.shift + task_.nodes.node_log2;
    g.node_scale = 1.0F / static_cast<float>(1 << g.node_shift);
    g.node_x0 = node_coordinate(place.x0, place.shift, task_.nodes.node_log2, task_.parameters.lookup);
    g.node_y0 = node_coordinate(place.y0, place.shift, task_.nodes.node_log2, task_.parameters.lookup);
    const int square = band == 0;
    if (square) {
      g.width *= 2;
      g.height *= 2;
      g.pitch *= 2;
      g.lo_i = local((task_.world.i0 << (s_ + 1)) - 2 * w.i0);
      g.lo_j = local((task_.world.j0 << (s_ + 1)) - 2 * w.j0);
      g.hi_i = local((task_.world.i1 << (s_ + 1)) - 1 - 2 * w.i0);
      g.hi_j = local((task_.world.j1 << (s_ + 1)) - 1 - 2 * w.j0);
    }
    g.i0 = static_cast<ls_uint>(w.i0 * (1 + square));
    g.j0 = static_cast<ls_uint>(w.j0 * (1 + square));
    const ls_uint algo = square                                          ? LS_ALGO_SQUARE_SQUARE
                         : task_.method == FractalMethod::kDiamondSquare ? LS_ALGO_DIAMOND_SQUARE
                         : task_.parameters.is_flora                     ? LS_ALGO_FLORA
                                                                         : LS_ALGO_OSTROWSKI;
    g.stream = ls_stream(static_cast<ls_uint>(task_.base_level + s_ + square), static_cast<ls_uint>(band),
                         algo, static_cast<ls_uint>(task_.parameters.channel));
    return g;
  }

  NodeKind kind(int band) const {
    switch (task_.method) {
      case FractalMethod::kSquareSquare:
        return NodeKind::kSquare;
      case FractalMethod::kDiamondSquare:
        return band == 3 ? NodeKind::kDiamondCentre : NodeKind::kDiamondEdge;
      default:
        return band == 3 ? NodeKind::kWaveletCentre : NodeKind::kWaveletEdge;
    }
  }

  // Deviations of this step's band, and its displacements before the rules.
  ls_step add_noise(int band, FractalSlot slot) {
    ls_step g = band_step(band);
    g.table_at = static_cast<int>(table_at(kind(band)));
    need(kSlotRows, static_cast<std::size_t>(g.pitch) * static_cast<std::size_t>(g.crop_h));
    need(slot, static_cast<std::size_t>(g.pitch) * static_cast<std::size_t>(g.height));
    ls_step rows = g;
    rows.height = g.crop_h;
    add(kKernelNodeRows, rows, {kSlotTable, kSlotRows});
    add(kKernelNoise, g, {kSlotRows, slot});
    return g;
  }

  std::size_t table_at(NodeKind node_kind) {
    if (table_step_ == s_ && table_kind_ == node_kind) return table_begin_;
    table_step_ = s_;
    table_kind_ = node_kind;
    table_begin_ = plan_.table.size();
    for (const NodeRoughness& node : task_.nodes.nodes)
      plan_.table.push_back(node_deviation(node, s_ + 1, node_kind));
    need(kSlotTable, plan_.table.size());
    return table_begin_;
  }

  void add_mask(const ls_step& band, FractalSlot slot) {
    if (!task_.mask && !task_.void_mask) return;
    const BandPlace place = band_place(task_, steps_[static_cast<std::size_t>(s_)], s_, band.band);
    const std::vector<float> keep =
        mask_factors(task_, place.x0, place.y0, place.shift, band.width, band.height, band.pitch);
    if (keep.empty()) return;
    ls_step g = band;
    g.table_at = static_cast<int>(plan_.keep.size());
    plan_.keep.insert(plan_.keep.end(), keep.begin(), keep.end());
    need(kSlotKeep, plan_.keep.size());
    add(kKernelScale, g, {kSlotKeep, slot});
  }

  void square_step(int s, FractalSlot from) {
    add_mask(add_noise(0, kSlotDelta1), kSlotDelta1);
    const FractalKernel next = base_.is_near_border ? kKernelSquareNext : kKernelSquareNextInner;
    add(s == 0 ? kKernelSquareFirst : next, base_, {from, kSlotDelta1, other(from)});
  }

  // Output posts from the cells around them.
  Plane square_posts(const Plane& cells) {
    ls_step g{};
    g.width = g.height = task_.posts;
    g.pitch = round16(task_.posts);
    g.parent_at = cells.at(task_.x0, task_.y0);
    g.parent_pitch = cells.pitch;
    g.lo_i = local((task_.world.i0 << task_.depth) - task_.x0);
    g.lo_j = local((task_.world.j0 << task_.depth) - task_.y0);
    g.hi_i = local((task_.world.i1 << task_.depth) - 1 - task_.x0);
    g.hi_j = local((task_.world.j1 << task_.depth) - 1 - task_.y0);
    need(other(cells.slot), static_cast<std::size_t>(g.pitch) * static_cast<std::size_t>(g.height));
    const bool is_inner = g.lo_i < 0 && g.lo_j < 0 && g.hi_i >= g.width && g.hi_j >= g.height;
    add(is_inner ? kKernelSquarePostsInner : kKernelSquarePosts, g, {cells.slot, other(cells.slot)});
    return {other(cells.slot), task_.x0, task_.y0, g.pitch};
  }

  void diamond_step(FractalSlot from) {
    const std::size_t size = static_cast<std::size_t>(base_.pitch) * static_cast<std::size_t>(base_.height);
    need(kSlotCentres, size);
    add_mask(add_noise(1, kSlotDelta1), kSlotDelta1);
    add_mask(add_noise(2, kSlotDelta2), kSlotDelta2);
    add_mask(add_noise(3, kSlotDelta3), kSlotDelta3);
    add(kKernelDiamondCentres, base_, {from, kSlotDelta3, kSlotCentres});
    add(base_.is_near_border ? kKernelDiamondQuads : kKernelDiamondQuadsInner, base_,
        {from, kSlotCentres, kSlotDelta1, kSlotDelta2, other(from)});
  }

  void wavelet_step(FractalSlot from) {
    const std::size_t size = static_cast<std::size_t>(base_.pitch) * static_cast<std::size_t>(base_.height);
    for (const FractalSlot slot :
         {kSlotWeight1, kSlotWeight2, kSlotWeight3, kSlotPosts, kSlotCentres, kSlotPosts2, kSlotCentres2})
      need(slot, size);
    const ls_step horizontal = add_noise(1, kSlotDelta1), vertical = add_noise(2, kSlotDelta2),
                  centre = add_noise(3, kSlotDelta3);
    const bool is_ruled = base_.has_altitude || base_.has_cap || base_.has_erosion;

    if (is_ruled) add(kKernelRuleCentres, centre, {from, kSlotDelta3});
    add_mask(centre, kSlotDelta3);
    const FractalKernel weights = base_.is_near_border ? kKernelWeights : kKernelWeightsInner;
    add(weights, centre, {kSlotDelta3, kSlotWeight3});
    add(kKernelHalf1Posts, base_, {from, kSlotWeight3, kSlotPosts});
    add(kKernelHalf1Centres, base_, {kSlotPosts, kSlotDelta3, kSlotCentres});

    for (const auto& [band, delta, weight] : {std::tuple{horizontal, kSlotDelta1, kSlotWeight1},
                                              std::tuple{vertical, kSlotDelta2, kSlotWeight2}}) {
      if (is_ruled) add(kKernelRuleEdges, band, {kSlotPosts, kSlotCentres, delta});
      add_mask(band, delta);
      add(weights, band, {delta, weight});
    }
    add(kKernelHalf2Old, base_,
        {kSlotPosts, kSlotCentres, kSlotWeight1, kSlotWeight2, kSlotPosts2, kSlotCentres2});
    add(kKernelHalf2Quads, base_, {kSlotPosts2, kSlotCentres2, kSlotDelta1, kSlotDelta2, other(from)});
  }

  const FractalTask& task_;
  const std::vector<FractalStep> steps_;
  FractalPlan plan_;
  int s_ = 0;
  ls_step base_{};
  int table_step_ = -1;
  NodeKind table_kind_ = NodeKind::kSquare;
  std::size_t table_begin_ = 0;
};

}  // namespace

FractalPlan make_plan(const FractalTask& task) { return Planner(task).make(); }

bool is_sixteen_wide(FractalKernel kernel) {
  switch (kernel) {
    case kKernelNoise:
    case kKernelSquareNextInner:
    case kKernelDiamondQuadsInner:
    case kKernelWeightsInner:
    case kKernelHalf1Posts:
    case kKernelHalf1Centres:
    case kKernelHalf2Old:
    case kKernelHalf2Quads:
      return true;
    default:
      return false;
  }
}

const char* kernel_name(FractalKernel kernel) {
  constexpr std::array<const char*, kKernelCount> kNames = {"ls_fractal_node_rows",
                                                            "ls_fractal_noise",
                                                            "ls_fractal_scale",
                                                            "ls_fractal_square_first",
                                                            "ls_fractal_square_next",
                                                            "ls_fractal_square_next_inner",
                                                            "ls_fractal_square_posts",
                                                            "ls_fractal_square_posts_inner",
                                                            "ls_fractal_diamond_centres",
                                                            "ls_fractal_diamond_quads",
                                                            "ls_fractal_diamond_quads_inner",
                                                            "ls_fractal_rule_centres",
                                                            "ls_fractal_weights",
                                                            "ls_fractal_weights_inner",
                                                            "ls_fractal_half1_posts",
                                                            "ls_fractal_half1_centres",
                                                            "ls_fractal_rule_edges",
                                                            "ls_fractal_half2_old",
                                                            "ls_fractal_half2_quads"};
  return kNames[kernel];
}

}  // namespace lodestone
