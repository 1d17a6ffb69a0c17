// Mask factors of displacements: sqrt(1 - mask) at the point, 0 near hard pixels. SPEC-SYNTHESIS 4 carried
// over to points.

#include <algorithm>
#include <cmath>

#include "kernels/fractal/fractal_plan.h"

namespace lodestone {
namespace {

// Pixels of one axis under point n: two for the bilinear value, and the range that the support meets.
// Relative to the crop.
struct AxisPixels {
  int p0, p1;
  float f;
  int first, last;
};

std::vector<AxisPixels> axis_pixels(std::int64_t x0, int count, int shift, std::int64_t origin, int size) {
  std::vector<AxisPixels> axis(static_cast<std::size_t>(count));
  const int q = std::max(shift, 1);
  const auto local = [&](std::int64_t p) {
    return static_cast<int>(std::clamp<std::int64_t>(p - origin, 0, size - 1));
  };
  const auto low = [&](std::int64_t v) { return shift >= 0 ? v >> shift : v * (std::int64_t{1} << -shift); };
  const auto high = [&](std::int64_t v) {
    return shift >= 0 ? ceil_shift(v, shift) : v * (std::int64_t{1} << -shift);
  };
  for (int n = 0; n < count; ++n) {
    const std::int64_t x = x0 + 2 * std::int64_t{n};
    const std::int64_t t = x * (std::int64_t{1} << (q - shift)) - (std::int64_t{1} << (q - 1));
    const std::int64_t p = t >> q;
    const float f =
        static_cast<float>(t - p * (std::int64_t{1} << q)) / static_cast<float>(std::int64_t{1} << q);
    axis[static_cast<std::size_t>(n)] = {local(p), local(p + 1), f, local(low(x - 3)),
                                         local(high(x + 3) - 1)};
  }
  return axis;
}

// Number of white pixels north-west of each pixel corner.
std::vector<int> white_sums(const MaskCrop& mask) {
  const std::size_t w = static_cast<std::size_t>(mask.width) + 1,
                    h = static_cast<std::size_t>(mask.height) + 1;
  std::vector<int> sums(w * h, 0);
  for (std::size_t j = 1; j < h; ++j) {
    int row = 0;
    for (std::size_t i = 1; i < w; ++i) {
      row += mask.pixels[(j - 1) * (w - 1) + i - 1] == 255;
      sums[j * w + i] = sums[(j - 1) * w + i] + row;
    }
  }
  return sums;
}

}  // namespace

std::vector<float> mask_factors(const FractalTask& task, std::int64_t x0, std::int64_t y0, int shift,
                                int columns, int rows, int pitch) {
  std::vector<float> keep(static_cast<std::size_t>(pitch) * static_cast<std::size_t>(rows), 1.0F);
  bool is_used = false;
  const auto any = [](const std::optional<MaskCrop>& mask) {
    return mask &&
           std::any_of(mask->pixels.begin(), mask->pixels.end(), [](std::uint8_t p) { return p != 0; });
  };
  const auto apply = [&](const MaskCrop& mask, bool is_soft, bool is_hard) {
    const std::vector<AxisPixels> xs = axis_pixels(x0, columns, shift - mask.level, mask.i0, mask.width);
    const std::vector<AxisPixels> ys = axis_pixels(y0, rows, shift - mask.level, mask.j0, mask.height);
    const std::vector<int> whites = is_hard ? white_sums(mask) : std::vector<int>{};
    const std::size_t sum_pitch = static_cast<std::size_t>(mask.width) + 1;
    const std::uint8_t* pixels = mask.pixels.data();
    const auto row_is_black = [&](int p) {
      const std::uint8_t* row = pixels + static_cast<std::ptrdiff_t>(p) * mask.width;
      return std::all_of(row, row + mask.width, [](std::uint8_t v) { return v == 0; });
    };
    for (int j = 0; j < rows; ++j) {
      const AxisPixels& y = ys[static_cast<std::size_t>(j)];
      float* out = keep.data() + static_cast<std::ptrdiff_t>(j) * pitch;
      const std::uint8_t* top_row = pixels + static_cast<std::ptrdiff_t>(y.p0) * mask.width;
      const std::uint8_t* bottom_row = pixels + static_cast<std::ptrdiff_t>(y.p1) * mask.width;
      if (is_soft && !(row_is_black(y.p0) && row_is_black(y.p1))) {
        for (int i = 0; i < columns; ++i) {
          const AxisPixels& x = xs[static_cast<std::size_t>(i)];
          const float a = top_row[x.p0], b = top_row[x.p1], c = bottom_row[x.p0], d = bottom_row[x.p1];
          const float top = a + x.f * (b - a), bottom = c + x.f * (d - c);
          out[i] = std::sqrt(std::max(0.0F, 255.0F - (top + y.f * (bottom - top))) / 255.0F) * out[i];
        }
      }
      if (!is_hard) continue;
      const int* above = whites.data() + static_cast<std::size_t>(y.first) * sum_pitch;
      const int* below = whites.data() + static_cast<std::size_t>(y.last + 1) * sum_pitch;
      if (below[mask.width] == above[mask.width]) continue;
      for (int i = 0; i < columns; ++i) {
        const AxisPixels& x = xs[static_cast<std::size_t>(i)];
        if (below[x.last + 1] - below[x.first] - above[x.last + 1] + above[x.first] > 0) out[i] = 0.0F;
      }
    }
    is_used = true;
  };
  if (any(task.mask)) apply(*task.mask, true, task.mask_mode == MaskMode::kProtect);
  if (any(task.void_mask)) apply(*task.void_mask, false, true);
  if (!is_used || std::all_of(keep.begin(), keep.end(), [](float k) { return k == 1.0F; })) return {};
  return keep;
}

}  // namespace lodestone
