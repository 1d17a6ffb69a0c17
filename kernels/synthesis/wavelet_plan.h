#pragma once
// WaveletPlan: the per-level tables of one WaveletTask in 32-bit form, made on the host for the kernels and the twin alike.
// Sources: SPEC-SYNTHESIS sections 2 (regions, mirror), 3.5 (sigma maps), 4 (masks).

#include <array>
#include <cstdint>
#include <vector>

#include "kernels/synthesis/wavelet_task.h"
#include "kernels/types/result.h"

namespace lodestone {

// A sigma map crop at one level, and where rows and columns of coefficients fall in it.
struct SigmaPlan {
  int width = 0, height = 0;
  std::vector<float> sigma_m;  // (s0 q .. q) kappa, row-major
  int u = 0;                   // position of relative column index 0, in 2^-shift entries
  std::vector<int> row_entry;  // per row of coefficients
  std::vector<float> row_fraction;
};

// Rows of the mask source under a row of coefficients.
struct MaskRow {
  int first = 0;
  int count = 0;  // 0: no pixel of them matters
  int begin = 0, end = 0;  // columns of coefficients that the pixels can reach
  std::array<std::uint8_t, 6> weight{};
};

// Mask source of one level: pixels of a power of two of fine cells each, or one value per fine vertex.
struct MaskPlan {
  int width = 0, height = 0;
  std::vector<std::uint32_t> source;  // LS_MASK_PIXEL_: value, protect flag
  // Per source row: columns of coefficients whose sums somebody reads (begin >= end: none). Sums elsewhere are never looked at.
  std::vector<int> begin, end;
  int x = 0;      // fine column of relative column index 0, from the source's first fine column
  int shift = 0;  // log2 of fine columns per entry
  bool is_vertices = false;
  std::vector<MaskRow> rows_odd, rows_even;
};

// Detail coefficients that lead from level base + s to the next one. Columns and rows: `posts` + 2 halo_... coefficients.
struct LevelPlan {
  int level = 0;    // absolute
  int posts = 0;    // coarse posts per edge, halo of the basis included
  int columns = 0;  // coefficients per edge; column 0 is `lead` before the first coarse post
  int lead = 0;
  int stride = 0;  // max(columns, 16)
  int crop_x = 0, crop_y = 0;  // where the fine posts used next start within all that are made (0 or 1)
  std::uint32_t base_i = 0, base_j = 0;
  std::vector<int> columns_odd, columns_even;  // stride + 16, periodic
  std::vector<int> rows_odd, rows_even;        // columns + 1
  std::array<float, 3> sigma_m{};              // GSA
  std::array<SigmaPlan, 3> maps;               // LSA
  int map_shift = 0;
};

struct WaveletPlan {
  WaveletMethod method = WaveletMethod::kLinear;  // kLinear also under an all-white mask
  bool has_mask = false;
  std::vector<LevelPlan> levels;
  std::vector<MaskPlan> masks;  // one per level if has_mask
};

// kInvalidArgument if the task breaks a rule of WaveletTask; the message names it.
Result<void> check_task(const WaveletTask& task);
// The task must have passed check_task().
WaveletPlan plan_task(const WaveletTask& task);

// Coefficients before the first and after the last coarse post that a level of this basis reads, and the coarse halo.
struct BasisHalo {
  int coarse;  // coarse posts around the region
  int before, after;  // coefficients around the region without halo
};
constexpr BasisHalo basis_halo(WaveletBasis basis) {
  return basis == WaveletBasis::kCdf22 ? BasisHalo{0, 1, 0} : BasisHalo{2, 4, 3};
}
// Region of level base + s without halo.
PostWindow level_window(const WaveletTask& task, int s);

}  // namespace lodestone
