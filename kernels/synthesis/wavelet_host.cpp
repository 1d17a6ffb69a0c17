// The plain C++ twin of wavelet.cl: one coefficient at a time, in the order of SPEC-SYNTHESIS 2-4.

#include <cmath>

#include "kernels/shared/ls_random.h"
#include "kernels/shared/ls_wavelet.h"
#include "kernels/synthesis/wavelet_plan.h"
#include "kernels/synthesis/wavelet_synthesis.h"
#include "kernels/wavelet/lifting.h"

namespace lodestone {

namespace {

// Horizontal sums of the mask source, for odd or even columns: height rows of stride ints.
std::vector<int> mask_sums(const MaskPlan& mask, const LevelPlan& level, bool is_odd) {
  std::vector<int> sums(static_cast<std::size_t>(mask.height) * static_cast<std::size_t>(level.stride));
  const std::vector<int>& columns = is_odd ? level.columns_odd : level.columns_even;
  const int n = ls_mask_count(is_odd, mask.is_vertices), first = ls_mask_first(is_odd, mask.is_vertices);
  for (int r = 0; r < mask.height; ++r) {
    const std::uint32_t* row = mask.source.data() + std::ptrdiff_t{r} * mask.width;
    int* out = sums.data() + std::ptrdiff_t{r} * level.stride;
    for (int c = 0; c < level.stride; ++c) {
      const int x = mask.x + 2 * columns[static_cast<std::size_t>(c)] + is_odd + first;
      int sum = 0;
      for (int k = 0; k < n; ++k) sum += ls_mask_weight(k, is_odd, mask.is_vertices) * static_cast<int>(row[(x + k) >> mask.shift]);
      out[c] = ls_mask_folded(sum);
    }
  }
  return sums;
}

int mask_sum(const std::vector<int>& sums, int stride, const MaskRow& row, int column) {
  int sum = 0;
  for (int k = 0; k < row.count; ++k)
    sum += row.weight[static_cast<std::size_t>(k)] * sums[static_cast<std::size_t>((row.first + k) * stride + column)];
  return sum;
}

class HostSynthesis final : public WaveletSynthesis {
 public:
  Result<void> run(std::span<const WaveletTask> tasks, std::span<std::vector<float>> heights_m) override {
    assert(tasks.size() == heights_m.size());
    for (const WaveletTask& task : tasks)
      if (Result<void> ok = check_task(task); !ok) return ok;
    for (std::size_t n = 0; n < tasks.size(); ++n) run_one(tasks[n], heights_m[n]);
    return {};
  }

 private:
  void run_one(const WaveletTask& task, std::vector<float>& heights_m) {
    const WaveletPlan plan = plan_task(task);
    std::vector<float> coarse = task.coarse_m, fine;
    for (std::size_t s = 0; s < plan.levels.size(); ++s) {
      const LevelPlan& level = plan.levels[s];
      std::array<const float*, 3> detail{};
      if (plan.method != WaveletMethod::kLinear) {
        make_details(task, plan, level, plan.has_mask ? &plan.masks[s] : nullptr);
        for (std::size_t band = 0; band < 3; ++band) detail[band] = detail_[band].data();
      }
      inverse_region(task.basis, coarse.data(), level.posts, level.posts, detail, level.stride, level.lead, fine);
      const int made = task.basis == WaveletBasis::kCdf22 ? 2 * level.posts - 1 : 2 * level.posts - 5;
      const bool is_last = s + 1 == plan.levels.size();
      const int halo = is_last ? basis_halo(task.basis).coarse : 0;
      const int want = is_last ? task.posts : plan.levels[s + 1].posts;
      std::vector<float>& next = is_last ? heights_m : coarse;
      next.clear();
      for (int j = 0; j < want; ++j) {
        const auto row = fine.begin() + std::ptrdiff_t{j + level.crop_y + halo} * made + level.crop_x + halo;
        next.insert(next.end(), row, row + want);
      }
    }
  }

  void make_details(const WaveletTask& task, const WaveletPlan& plan, const LevelPlan& level, const MaskPlan* mask) {
    const auto count = static_cast<std::size_t>(level.columns) * static_cast<std::size_t>(level.stride);
    std::array<std::vector<int>, 2> sums;
    if (mask != nullptr) sums = {mask_sums(*mask, level, false), mask_sums(*mask, level, true)};
    const auto seed0 = static_cast<std::uint32_t>(task.seed), seed1 = static_cast<std::uint32_t>(task.seed >> 32);
    const bool is_nearest = task.lookup == SigmaLookup::kNearest;
    for (std::size_t band = 0; band < 3; ++band) {
      const bool odd_x = band != 1, odd_y = band != 0;
      const std::vector<int>& columns = odd_x ? level.columns_odd : level.columns_even;
      const std::vector<int>& rows = odd_y ? level.rows_odd : level.rows_even;
      const std::uint32_t stream = ls_stream(static_cast<std::uint32_t>(level.level), static_cast<std::uint32_t>(band) + 1, LS_ALGO_WAVELET, 0);
      const int energy = LS_MASK_FULL * (band == 2 ? LS_MASK_ENERGY_DIAGONAL : LS_MASK_ENERGY_MIXED);
      std::vector<float>& plane = detail_[band];
      plane.resize(count);
      for (int r = 0; r < level.columns; ++r) {
        const auto row = static_cast<std::size_t>(r);
        const std::uint32_t j = level.base_j + static_cast<std::uint32_t>(rows[row]);
        for (int c = 0; c < level.stride; ++c) {
          const int column = columns[static_cast<std::size_t>(c)];
          const std::uint32_t i = level.base_i + static_cast<std::uint32_t>(column);
          float& d = plane[row * static_cast<std::size_t>(level.stride) + static_cast<std::size_t>(c)];
          int removed = 0;
          if (mask != nullptr) {
            removed = mask_sum(sums[odd_x], level.stride, (odd_y ? mask->rows_odd : mask->rows_even)[row], c);
            if (removed >= energy) {
              d = 0.0f;
              continue;
            }
          }
          float sigma = level.sigma_m[band];
          if (plan.method == WaveletMethod::kLsa) {
            const SigmaPlan& map = level.maps[band];
            float f = 0;
            const int entry = ls_map_entry(map.u + 2 * column, map.width, level.map_shift, is_nearest, &f);
            const int next = std::min(entry + 1, map.width - 1);
            const int row0 = map.row_entry[row], row1 = std::min(row0 + 1, map.height - 1);
            const float* top = map.sigma_m.data() + std::ptrdiff_t{row0} * map.width;
            const float* bot = map.sigma_m.data() + std::ptrdiff_t{row1} * map.width;
            sigma = ls_mix(ls_mix(top[entry], top[next], f), ls_mix(bot[entry], bot[next], f), map.row_fraction[row]);
          }
          d = sigma * ls_gaussian(i, j, stream, seed0, seed1);
          if (removed != 0) d = d * std::sqrt(static_cast<float>(energy - removed) / static_cast<float>(energy));
        }
      }
    }
  }

  std::array<std::vector<float>, 3> detail_;
};

}  // namespace

std::unique_ptr<WaveletSynthesis> make_host_wavelet_synthesis() { return std::make_unique<HostSynthesis>(); }

}  // namespace lodestone
