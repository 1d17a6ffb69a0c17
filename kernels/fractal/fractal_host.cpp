// The plain C++ twin: every operation of the plan in loops over the shared functions.

#include <algorithm>
#include <string>

#include "kernels/fractal/fractal_plan.h"
#include "kernels/fractal/fractal_synthesis.h"

namespace lodestone {
namespace {

class HostFractalSynthesis final : public FractalSynthesis {
 public:
  Result<void> run(std::span<const FractalTask> tasks, std::span<std::vector<float>> heights_m) override {
    for (std::size_t n = 0; n < tasks.size(); ++n) {
      if (Result<void> ok = check(tasks[n]); !ok)
        return std::move(ok.error()).within("task " + std::to_string(n));
      const FractalPlan plan = make_plan(tasks[n]);
      for (std::size_t slot = 0; slot < kSlotCount; ++slot) {
        const std::size_t size = plan.floats[slot] + 2 * LS_FRACTAL_GUARD;
        if (planes_[slot].size() < size) planes_[slot].assign(size, 0.0F);
      }
      fill(kSlotHeightsA, plan.heights);
      fill(kSlotTable, plan.table);
      fill(kSlotKeep, plan.keep);
      for (const FractalOp& op : plan.ops) carry_out(op);
      const std::size_t posts = static_cast<std::size_t>(tasks[n].posts);
      heights_m[n].resize(posts * posts);
      const float* from = plane(plan.out) + plan.out_at;
      for (std::size_t j = 0; j < posts; ++j)
        std::copy(from + j * plan.out_pitch, from + j * plan.out_pitch + posts,
                  heights_m[n].begin() + static_cast<std::ptrdiff_t>(j * posts));
    }
    return {};
  }

 private:
  float* plane(FractalSlot slot) { return planes_[slot].data() + LS_FRACTAL_GUARD; }
  void fill(FractalSlot slot, const std::vector<float>& values) {
    std::copy(values.begin(), values.end(), plane(slot));
  }

  template <class Function>
  static void each(const FractalOp& op, Function function) {
    for (int j = 0; j < op.rows; ++j)
      for (int i = 0; i < op.columns; ++i) function(i, j);
  }

  void carry_out(const FractalOp& op) {
    const ls_step* g = &op.step;
    std::array<float*, 6> p{};
    for (int n = 0; n < op.slot_count; ++n)
      p[static_cast<std::size_t>(n)] = plane(op.slots[static_cast<std::size_t>(n)]);
    switch (op.kernel) {
      case kKernelNodeRows:
        return each(op, [&](int i, int j) { ls_node_row(g, i, j, p[0], p[1]); });
      case kKernelNoise:
        return each(op, [&](int i, int j) { p[1][j * g->pitch + i] = ls_displacement(g, i, j, p[0]); });
      case kKernelScale:
        return each(op, [&](int i, int j) { ls_scale(g, i, j, p[0], p[1]); });
      case kKernelSquareFirst:
        return each(op, [&](int i, int j) { ls_square_first(g, i, j, p[0], p[1], p[2]); });
      case kKernelSquareNext:
        return each(op, [&](int i, int j) { ls_square_next(g, i, j, p[0], p[1], p[2]); });
      case kKernelSquareNextInner:
        return each(op, [&](int i, int j) { ls_square_next_inner(g, i, j, p[0], p[1], p[2]); });
      case kKernelSquarePostsInner:
        return each(op, [&](int i, int j) { ls_square_post_inner(g, i, j, p[0], p[1]); });
      case kKernelSquarePosts:
        return each(op, [&](int i, int j) { ls_square_post(g, i, j, p[0], p[1]); });
      case kKernelDiamondCentres:
        return each(op, [&](int i, int j) { ls_diamond_centre(g, i, j, p[0], p[1], p[2]); });
      case kKernelDiamondQuads:
      case kKernelDiamondQuadsInner:
        return each(op, [&](int i, int j) { ls_diamond_quad(g, i, j, p[0], p[1], p[2], p[3], p[4]); });
      case kKernelRuleCentres:
        return each(op, [&](int i, int j) { ls_rule_centre(g, i, j, p[0], p[1]); });
      case kKernelWeights:
      case kKernelWeightsInner:
        return each(op, [&](int i, int j) { ls_weight(g, i, j, p[0], p[1]); });
      case kKernelHalf1Posts:
        return each(op, [&](int i, int j) { ls_half1_post(g, i, j, p[0], p[1], p[2]); });
      case kKernelHalf1Centres:
        return each(op, [&](int i, int j) { ls_half1_centre(g, i, j, p[0], p[1], p[2]); });
      case kKernelRuleEdges:
        return each(op, [&](int i, int j) { ls_rule_edge(g, i, j, p[0], p[1], p[2]); });
      case kKernelHalf2Old:
        return each(op, [&](int i, int j) { ls_half2_old(g, i, j, p[0], p[1], p[2], p[3], p[4], p[5]); });
      case kKernelHalf2Quads:
        return each(op, [&](int i, int j) { ls_half2_quad(g, i, j, p[0], p[1], p[2], p[3], p[4]); });
      case kKernelCount:
        break;
    }
  }

  std::array<std::vector<float>, kSlotCount> planes_;
};

}  // namespace

std::unique_ptr<FractalSynthesis> make_host_fractal_synthesis() {
  return std::make_unique<HostFractalSynthesis>();
}

}  // namespace lodestone
