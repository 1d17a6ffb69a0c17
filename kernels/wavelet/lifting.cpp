#include "kernels/wavelet/lifting.h"

#include <cstddef>

#include "kernels/shared/ls_wavelet.h"

namespace lodestone {

namespace {

// Whole-sample mirror into 0..last, repeated for far indices; last >= 1.
int reflect(int i, int last) {
  const int period = 2 * last;
  i = ((i % period) + period) % period;
  return i <= last ? i : period - i;
}

// A line of samples in memory.
struct Line {
  const float* data;
  std::ptrdiff_t step;
  float operator[](int n) const { return data == nullptr ? 0.0f : data[n * step]; }
};

// One inverse step of a line: `count` coarse posts, details from index -lead on. Returns through `put(n, value)`.
template <class Put>
void inverse_line(WaveletBasis basis, Line c, Line d, int count, int lead, const Put& put) {
  const auto detail = [&](int i) { return d[i + lead]; };
  if (basis == WaveletBasis::kCdf22) {
    float before = LS_EVEN22(c[0], detail(-1), detail(0));
    put(0, before);
    for (int i = 1; i < count; ++i) {
      const float after = LS_EVEN22(c[i], detail(i - 1), detail(i));
      put(2 * i - 1, LS_ODD22(detail(i - 1), before, after));
      put(2 * i, after);
      before = after;
    }
    return;
  }
  const auto s = [&](int i) { return ls_s44(c[i], detail(i - 2), detail(i - 1), detail(i), detail(i + 1)); };
  const auto odd = [&](int i) { return ls_odd44(detail(i), s(i), s(i + 1)); };
  for (int i = 1; i < count - 1; ++i) {
    put(2 * (i - 1), ls_even44(s(i), odd(i - 1), odd(i)));
    if (i < count - 2) put(2 * (i - 1) + 1, odd(i));
  }
}

int fine_count(WaveletBasis basis, int coarse) { return basis == WaveletBasis::kCdf22 ? 2 * coarse - 1 : 2 * coarse - 5; }

// One analysis step of a line of n samples; low: ceil(n/2), high: floor(n/2) values.
template <class PutLow, class PutHigh>
void forward_line(WaveletBasis basis, Line x, int n, const PutLow& put_low, const PutHigh& put_high) {
  const auto sample = [&](int i) { return x[reflect(i, n - 1)]; };
  const int lows = (n + 1) / 2, highs = n / 2;
  if (basis == WaveletBasis::kCdf22) {
    const auto high = [&](int i) { return LS_HIGH22(sample(2 * i + 1), sample(2 * i), sample(2 * i + 2)); };
    for (int i = 0; i < highs; ++i) put_high(i, high(i));
    for (int i = 0; i < lows; ++i) put_low(i, LS_LOW22(sample(2 * i), high(i - 1), high(i)));
    return;
  }
  const auto s0 = [&](int i) { return sample(2 * i) - (sample(2 * i - 1) + sample(2 * i + 1)) * 0.25f; };
  const auto high = [&](int i) { return sample(2 * i + 1) - (s0(i) + s0(i + 1)); };
  for (int i = 0; i < highs; ++i) put_high(i, high(i) * 0.5f);
  for (int i = 0; i < lows; ++i) {
    const float near = (high(i - 1) + high(i)) * (29.0f / 128.0f), far = (high(i - 2) + high(i + 1)) * (5.0f / 128.0f);
    put_low(i, (s0(i) + (near - far)) * 2.0f);
  }
}

}  // namespace

void inverse_region(WaveletBasis basis, const float* coarse_m, int width, int height, std::array<const float*, 3> detail, int stride,
                    int lead, std::vector<float>& fine_m) {
  const int fine_width = fine_count(basis, width), fine_height = fine_count(basis, height);
  // Columns first: lo from c and d2, hx from d1 and d3. hx has the columns of the details.
  const int halo_width = basis == WaveletBasis::kCdf22 ? width + lead : width + lead + 1;
  std::vector<float> lo(static_cast<std::size_t>(width) * static_cast<std::size_t>(fine_height));
  std::vector<float> hx(static_cast<std::size_t>(halo_width) * static_cast<std::size_t>(fine_height));
  const bool is_flat = detail[0] == nullptr;
  for (int i = 0; i < width; ++i)
    inverse_line(basis, {coarse_m + i, width}, {is_flat ? nullptr : detail[1] + lead + i, stride}, height, lead,
                 [&](int n, float v) { lo[static_cast<std::size_t>(n) * static_cast<std::size_t>(width) + static_cast<std::size_t>(i)] = v; });
  for (int i = 0; i < halo_width && !is_flat; ++i)
    inverse_line(basis, {detail[0] + std::ptrdiff_t{lead} * stride + i, stride}, {detail[2] + i, stride}, height, lead, [&](int n, float v) {
      hx[static_cast<std::size_t>(n) * static_cast<std::size_t>(halo_width) + static_cast<std::size_t>(i)] = v;
    });
  fine_m.resize(static_cast<std::size_t>(fine_width) * static_cast<std::size_t>(fine_height));
  for (int j = 0; j < fine_height; ++j) {
    float* out = fine_m.data() + std::ptrdiff_t{j} * fine_width;
    inverse_line(basis, {lo.data() + std::ptrdiff_t{j} * width, 1}, {is_flat ? nullptr : hx.data() + std::ptrdiff_t{j} * halo_width, 1},
                 width, lead, [&](int n, float v) { out[n] = v; });
  }
}

GridBands forward_lifting(WaveletBasis basis, const std::vector<float>& fine_m, int width, int height) {
  GridBands bands;
  bands.width = width;
  bands.height = height;
  const int lw = (width + 1) / 2, hw = width / 2, lh = (height + 1) / 2, hh = height / 2;
  const auto area = [](int w, int h) { return static_cast<std::size_t>(w) * static_cast<std::size_t>(h); };
  std::vector<float> low(area(lw, height)), high(area(hw, height));
  for (int j = 0; j < height; ++j)
    forward_line(basis, {fine_m.data() + std::ptrdiff_t{j} * width, 1}, width, [&](int i, float v) { low[area(lw, j) + static_cast<std::size_t>(i)] = v; },
                 [&](int i, float v) { high[area(hw, j) + static_cast<std::size_t>(i)] = v; });
  bands.low_m.resize(area(lw, lh));
  bands.detail_m = {std::vector<float>(area(hw, lh)), std::vector<float>(area(lw, hh)), std::vector<float>(area(hw, hh))};
  const auto columns = [&](const std::vector<float>& in, int w, std::vector<float>& out_low, std::vector<float>& out_high) {
    for (int i = 0; i < w; ++i)
      forward_line(basis, {in.data() + i, w}, height, [&](int j, float v) { out_low[area(w, j) + static_cast<std::size_t>(i)] = v; },
                   [&](int j, float v) { out_high[area(w, j) + static_cast<std::size_t>(i)] = v; });
  };
  columns(low, lw, bands.low_m, bands.detail_m[1]);
  columns(high, hw, bands.detail_m[0], bands.detail_m[2]);
  return bands;
}

std::vector<float> inverse_lifting(WaveletBasis basis, const GridBands& bands) {
  const HaloedBands in = add_halo(basis, bands);
  std::vector<float> fine, out;
  inverse_region(basis, in.low_m.data(), in.width, in.height, {in.detail_m[0].data(), in.detail_m[1].data(), in.detail_m[2].data()},
                 in.stride, in.lead, fine);
  const int fine_width = fine_count(basis, in.width);
  out.reserve(static_cast<std::size_t>(bands.width) * static_cast<std::size_t>(bands.height));
  for (int j = 0; j < bands.height; ++j) {
    const auto row = fine.begin() + std::ptrdiff_t{j + in.fine_skip} * fine_width + in.fine_skip;
    out.insert(out.end(), row, row + bands.width);
  }
  return out;
}

HaloedBands add_halo(WaveletBasis basis, const GridBands& bands) {
  HaloedBands out;
  const bool is_22 = basis == WaveletBasis::kCdf22;
  const int halo = is_22 ? 0 : 2, before = is_22 ? 1 : 4, after = is_22 ? 0 : 3;
  const int w = bands.width, h = bands.height;
  // Coarse posts 0..ceil((n - 1) / 2) of each axis, halo around them.
  out.width = w / 2 + 1 + 2 * halo;
  out.height = h / 2 + 1 + 2 * halo;
  out.lead = before - halo;
  out.stride = w / 2 + 1 + before + after;
  out.rows = h / 2 + 1 + before + after;
  out.fine_skip = is_22 ? 0 : 2;
  const auto entry = [](const std::vector<float>& band, int band_width, int fine_x, int fine_y) {
    return band[static_cast<std::size_t>(fine_y / 2) * static_cast<std::size_t>(band_width) + static_cast<std::size_t>(fine_x / 2)];
  };
  const int lw = (w + 1) / 2, hw = w / 2;
  // Every sample of the interleaved grid is mirrored about the fine grid's border posts.
  for (int j = -halo; j < out.height - halo; ++j)
    for (int i = -halo; i < out.width - halo; ++i) out.low_m.push_back(entry(bands.low_m, lw, reflect(2 * i, w - 1), reflect(2 * j, h - 1)));
  for (int band = 0; band < 3; ++band) {
    const int ox = band != 1, oy = band != 0;
    for (int j = -before; j < out.rows - before; ++j)
      for (int i = -before; i < out.stride - before; ++i)
        out.detail_m[static_cast<std::size_t>(band)].push_back(
            entry(bands.detail_m[static_cast<std::size_t>(band)], ox ? hw : lw, reflect(2 * i + ox, w - 1), reflect(2 * j + oy, h - 1)));
  }
  return out;
}

}  // namespace lodestone
