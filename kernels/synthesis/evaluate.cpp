// Hold-out metrics of SPEC-SYNTHESIS 9, items 5-7. Readings of the text:
//   box energies  every 9x9 box that fits in the finest level (the whole level where it is narrower); energy
//   = mean over its valid
//                 coefficients of d1^2 + d2^2 + d3^2; boxes with fewer than half valid are left out
//   spectrum      Welch: half-overlapping square blocks of 2^n <= 256 posts without voids, plane removed,
//   Hann window, 2-D FFT;
//                 power averaged over rings of whole wave numbers, over x and y alike; plain least squares of
//                 log2 power over log2 frequency
//   kurtosis      fourth over squared second moment about zero; 0 when there are no details

#include "kernels/synthesis/evaluate.h"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <complex>
#include <numbers>

namespace lodestone {
namespace {

constexpr double kFlatVariance = 0x1p-40;  // m^2
constexpr int kBox = 9;
constexpr std::int64_t kMaxSpectrum = 256, kMinSpectrum = 8;

struct Sums {
  double second = 0, fourth = 0;
  std::int64_t count = 0;
};

Sums moments(const AnalysisStep& step, std::size_t band) {
  Sums sums;
  for (std::size_t n = 0; n < step.detail_m[band].size(); ++n) {
    if (step.detail_void[band][n] != 0) continue;
    const double square = static_cast<double>(step.detail_m[band][n]) * step.detail_m[band][n];
    sums.second += square;
    sums.fourth += square * square;
    ++sums.count;
  }
  return sums;
}

double variance_of(const Sums& s) { return s.count == 0 ? 0.0 : s.second / static_cast<double>(s.count); }

double kurtosis_of(const Sums& s) {
  const double variance = variance_of(s);
  return variance > kFlatVariance ? s.fourth / static_cast<double>(s.count) / (variance * variance) : 0.0;
}

HeightGrid coarse_grid(AnalysisStep&& step) {
  return {step.coarse, std::move(step.low_m), std::move(step.low_void)};
}

// Energies of boxes; negative where too few coefficients are valid.
std::vector<double> box_energies(const AnalysisStep& step, const std::vector<std::uint8_t>& invalid) {
  const std::int64_t width = step.coarse.width(), height = step.coarse.height();
  const std::int64_t bw = std::min<std::int64_t>(kBox, width), bh = std::min<std::int64_t>(kBox, height);
  const std::int64_t nx = width - bw + 1, ny = height - bh + 1;
  std::vector<double> row_sum(static_cast<std::size_t>(nx * height)), row_count(row_sum.size());
  for (std::int64_t j = 0; j < height; ++j) {
    for (std::int64_t i = 0; i < nx; ++i) {
      double sum = 0, count = 0;
      for (std::int64_t k = 0; k < bw; ++k) {
        const auto at = static_cast<std::size_t>(j * width + i + k);
        if (invalid[at] != 0) continue;
        for (const auto& band : step.detail_m) sum += static_cast<double>(band[at]) * band[at];
        count += 1;
      }
      row_sum[static_cast<std::size_t>(j * nx + i)] = sum;
      row_count[static_cast<std::size_t>(j * nx + i)] = count;
    }
  }
  std::vector<double> energies;
  energies.reserve(static_cast<std::size_t>(nx * ny));
  for (std::int64_t j = 0; j < ny; ++j) {
    for (std::int64_t i = 0; i < nx; ++i) {
      double sum = 0, count = 0;
      for (std::int64_t k = 0; k < bh; ++k) {
        sum += row_sum[static_cast<std::size_t>((j + k) * nx + i)];
        count += row_count[static_cast<std::size_t>((j + k) * nx + i)];
      }
      energies.push_back(2 * count < static_cast<double>(bw * bh) ? -1.0 : sum / count);
    }
  }
  return energies;
}

// log2 with the floor of 1e-4 of the mean; empty when there is no energy at all.
std::vector<double> log_energies(const std::vector<double>& energies) {
  double sum = 0;
  std::size_t count = 0;
  for (const double e : energies) {
    if (e < 0) continue;
    sum += e;
    ++count;
  }
  if (count == 0 || !(sum / static_cast<double>(count) > kFlatVariance)) return {};
  const double floor = 1e-4 * sum / static_cast<double>(count);
  std::vector<double> logs;
  for (const double e : energies) logs.push_back(e < 0 ? 0.0 : det_log2(std::max(e, floor)));
  return logs;
}

double box_correlation(const AnalysisStep& real, const AnalysisStep& synthetic) {
  std::vector<std::uint8_t> invalid(real.low_m.size(), 0);
  for (std::size_t n = 0; n < invalid.size(); ++n) {
    for (std::size_t t = 0; t < 3; ++t) invalid[n] |= real.detail_void[t][n] | synthetic.detail_void[t][n];
  }
  const std::vector<double> boxes = box_energies(real, invalid);
  const std::vector<double> x = log_energies(boxes), y = log_energies(box_energies(synthetic, invalid));
  if (x.empty() || y.empty()) return 0;
  double n = 0, mean_x = 0, mean_y = 0;
  for (std::size_t k = 0; k < boxes.size(); ++k) {
    if (boxes[k] < 0) continue;
    n += 1;
    mean_x += x[k];
    mean_y += y[k];
  }
  mean_x /= n;
  mean_y /= n;
  double xx = 0, yy = 0, xy = 0;
  for (std::size_t k = 0; k < boxes.size(); ++k) {
    if (boxes[k] < 0) continue;
    xx += (x[k] - mean_x) * (x[k] - mean_x);
    yy += (y[k] - mean_y) * (y[k] - mean_y);
    xy += (x[k] - mean_x) * (y[k] - mean_y);
  }
  return xx > 1e-12 && yy > 1e-12 ? xy / std::sqrt(xx * yy) : 0.0;
}

using Complex = std::complex<double>;

// In-place radix-2 transform of n = 2^k values, `stride` apart.
void fft(Complex* v, std::size_t n, std::size_t stride, const std::vector<Complex>& roots) {
  for (std::size_t i = 1, j = 0; i < n; ++i) {
    std::size_t bit = n >> 1;
    for (; (j & bit) != 0; bit >>= 1) j ^= bit;
    j |= bit;
    if (i < j) std::swap(v[i * stride], v[j * stride]);
  }
  for (std::size_t half = 1; half < n; half *= 2) {
    for (std::size_t from = 0; from < n; from += 2 * half) {
      for (std::size_t k = 0; k < half; ++k) {
        Complex& a = v[(from + k) * stride];
        Complex& b = v[(from + k + half) * stride];
        const Complex w = roots[k * (n / (2 * half))];
        const Complex turned(b.real() * w.real() - b.imag() * w.imag(),
                             b.real() * w.imag() + b.imag() * w.real());
        b = a - turned;
        a += turned;
      }
    }
  }
}

// Adds one block's power to the rings: ring r holds wave numbers that round to r cycles per block.
void add_block(const HeightGrid& grid, std::int64_t i0, std::int64_t j0, std::int64_t n,
               std::vector<double>& rings) {
  const auto un = static_cast<std::size_t>(n);
  std::vector<double> z(un * un);
  double mean = 0, slope_x = 0, slope_y = 0, norm = 0;
  const double middle = 0.5 * static_cast<double>(n - 1);
  for (std::size_t j = 0; j < un; ++j) {
    for (std::size_t i = 0; i < un; ++i) {
      const double h = grid.at(i0 + static_cast<std::int64_t>(i), j0 + static_cast<std::int64_t>(j));
      const double x = static_cast<double>(i) - middle, y = static_cast<double>(j) - middle;
      z[j * un + i] = h;
      mean += h;
      slope_x += h * x;
      slope_y += h * y;
      norm += x * x;
    }
  }
  mean /= static_cast<double>(n * n);
  std::vector<double> hann(un);
  std::vector<Complex> roots(un / 2), f(un * un);
  for (std::size_t i = 0; i < un; ++i) {
    const double turn = 2 * std::numbers::pi * static_cast<double>(i) / static_cast<double>(n);
    hann[i] = 0.5 - 0.5 * std::cos(turn);
    if (i < un / 2) roots[i] = {std::cos(turn), -std::sin(turn)};
  }
  for (std::size_t j = 0; j < un; ++j) {
    for (std::size_t i = 0; i < un; ++i) {
      const double x = static_cast<double>(i) - middle, y = static_cast<double>(j) - middle;
      f[j * un + i] = (z[j * un + i] - mean - (slope_x * x + slope_y * y) / norm) * hann[i] * hann[j];
    }
  }
  for (std::size_t j = 0; j < un; ++j) fft(f.data() + j * un, un, 1, roots);
  for (std::size_t i = 0; i < un; ++i) fft(f.data() + i, un, un, roots);
  std::vector<double> power(rings.size(), 0.0), count(rings.size(), 0.0);
  for (std::int64_t j = 0; j < n; ++j) {
    for (std::int64_t i = 0; i < n; ++i) {
      const auto kx = static_cast<double>(i <= n / 2 ? i : i - n),
                 ky = static_cast<double>(j <= n / 2 ? j : j - n);
      const auto ring = static_cast<std::size_t>(std::sqrt(kx * kx + ky * ky) + 0.5);
      if (ring >= rings.size()) continue;
      power[ring] += std::norm(f[static_cast<std::size_t>(j * n + i)]);
      count[ring] += 1;
    }
  }
  for (std::size_t r = 0; r < rings.size(); ++r) rings[r] += count[r] > 0 ? power[r] / count[r] : 0.0;
}

bool has_void(const HeightGrid& a, const HeightGrid& b, std::int64_t i0, std::int64_t j0, std::int64_t n) {
  if (a.is_void.empty() && b.is_void.empty()) return false;
  for (std::int64_t j = j0; j < j0 + n; ++j) {
    for (std::int64_t i = i0; i < i0 + n; ++i) {
      if (a.void_at(i, j) || b.void_at(i, j)) return true;
    }
  }
  return false;
}

// Slope of log2 power over log2 frequency between 2^-(k+2) and 0.45 cycles per post; 0 when nothing can be
// measured.
double ring_slope(const std::vector<double>& rings, std::int64_t n, int k) {
  double count = 0, sx = 0, sy = 0, sxx = 0, sxy = 0;
  for (std::size_t r = 1; r < rings.size(); ++r) {
    const double frequency = static_cast<double>(r) / static_cast<double>(n);
    if (frequency < std::ldexp(1.0, -(k + 2)) || frequency > 0.45 || !(rings[r] > 1e-30)) continue;
    const double x = det_log2(frequency), y = det_log2(rings[r]);
    count += 1;
    sx += x;
    sy += y;
    sxx += x * x;
    sxy += x * y;
  }
  return count < 2 ? 0.0 : (sxy - sx * sy / count) / (sxx - sx * sx / count);
}

// {real, synthetic}, over the same blocks.
std::array<double, 2> spectrum_slopes(const HeightGrid& real, const HeightGrid& synthetic, int k) {
  const PostWindow& w = real.window;
  for (std::int64_t n = kMaxSpectrum; n >= kMinSpectrum; n /= 2) {
    if (n > w.width() || n > w.height()) continue;
    std::vector<double> of_real(static_cast<std::size_t>(n / 2 + 1)), of_synthetic(of_real.size());
    bool any = false;
    for (std::int64_t j = w.j0; j + n - 1 <= w.j1; j += n / 2) {
      for (std::int64_t i = w.i0; i + n - 1 <= w.i1; i += n / 2) {
        if (has_void(real, synthetic, i, j, n)) continue;
        add_block(real, i, j, n, of_real);
        add_block(synthetic, i, j, n, of_synthetic);
        any = true;
      }
    }
    if (any) return {ring_slope(of_real, n, k), ring_slope(of_synthetic, n, k)};
  }
  return {0, 0};
}

// Both variances are floored, so that flat against flat is 0 and flat against rough is finite.
double log2_ratio(double synthetic, double real) {
  return det_log2(std::max(synthetic, kFlatVariance)) - det_log2(std::max(real, kFlatVariance));
}

}  // namespace

HoldOutMetrics compare_levels(const HeightGrid& real, const HeightGrid& synthetic, int k) {
  assert(real.window == synthetic.window && "the two grids show different ground");
  assert(k >= 1 && k <= 16 && "one level at least has to be held out");
  HoldOutMetrics metrics;
  const auto slopes = spectrum_slopes(real, synthetic, k);
  metrics.slope_real = slopes[0];
  metrics.slope_synthetic = slopes[1];

  // Posts that are void in either grid are void in both.
  HeightGrid a = real, b = synthetic;
  if (a.is_void.empty()) a.is_void = b.is_void;
  for (std::size_t n = 0; n < b.is_void.size(); ++n) a.is_void[n] |= b.is_void[n];
  b.is_void = a.is_void;

  double squares = 0, count = 0;
  for (int level = 0; level < k && a.window.width() > 1 && a.window.height() > 1; ++level) {
    const PostWindow world = a.window;
    AnalysisStep step_a = analyse(a, world, coarse_world(world));
    AnalysisStep step_b = analyse(b, world, coarse_world(world));
    std::array<double, 3> ratios{};
    for (std::size_t t = 0; t < 3; ++t) {
      const Sums of_a = moments(step_a, t), of_b = moments(step_b, t);
      if (level == 0 && t == 2) {
        metrics.kurtosis_real = kurtosis_of(of_a);
        metrics.kurtosis_synthetic = kurtosis_of(of_b);
      }
      if (of_a.count == 0) continue;
      ratios[t] = log2_ratio(variance_of(of_b), variance_of(of_a));
      squares += ratios[t] * ratios[t];
      count += 1;
    }
    metrics.log2_variance_ratio.push_back(ratios);
    if (level == 0) metrics.rough_corr = box_correlation(step_a, step_b);
    a = coarse_grid(std::move(step_a));
    b = coarse_grid(std::move(step_b));
  }
  metrics.band_rms = count > 0 ? std::sqrt(squares / count) : 0.0;
  return metrics;
}

}  // namespace lodestone
