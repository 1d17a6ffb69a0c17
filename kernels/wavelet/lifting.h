#pragma once
// CDF(2,2) and CDF(4,4) lifting of whole grids: plain C++, and the same bits on an OpenCL device.
// Source: SPEC-SYNTHESIS section 2; border: whole-sample mirror. Amplitude normalisation: coarse values stay heights.

#include <array>
#include <memory>
#include <vector>

#include "kernels/device/device.h"
#include "kernels/synthesis/wavelet_task.h"
#include "kernels/types/result.h"

namespace lodestone {

// One analysis step of a width x height grid (both >= 2), row-major. low_m: ceil(width/2) * ceil(height/2).
// detail_m: d1 floor(w/2) x ceil(h/2), d2 ceil(w/2) x floor(h/2), d3 floor(w/2) x floor(h/2).
struct GridBands {
  int width = 0, height = 0;  // of the fine grid
  std::vector<float> low_m;
  std::array<std::vector<float>, 3> detail_m;
};

GridBands forward_lifting(WaveletBasis basis, const std::vector<float>& fine_m, int width, int height);
std::vector<float> inverse_lifting(WaveletBasis basis, const GridBands& bands);

// The same on a device; one object per thread. Errors: kDevice.
class DeviceLifting {
 public:
  static Result<std::unique_ptr<DeviceLifting>> create(std::shared_ptr<Device> device);
  virtual ~DeviceLifting() = default;
  virtual Result<GridBands> forward(WaveletBasis basis, const std::vector<float>& fine_m, int width, int height) = 0;
  virtual Result<std::vector<float>> inverse(WaveletBasis basis, const GridBands& bands) = 0;
};

// The bands of a whole grid with the mirrored coefficients around them that inverse_region() reads.
struct HaloedBands {
  int width = 0, height = 0, lead = 0, stride = 0, rows = 0;  // as inverse_region() takes them; `rows` of details
  int fine_skip = 0;  // fine posts before the grid's first one
  std::vector<float> low_m;
  std::array<std::vector<float>, 3> detail_m;
};
HaloedBands add_halo(WaveletBasis basis, const GridBands& bands);

// Regions, for the synthesis twin: one inverse step from haloed details.
//   coarse_m   width * height posts;  detail[t]: rows of `stride` coefficients, the first row and column `lead` before the first
//              post; null pointers mean 0. kCdf22 reads one coefficient before the posts, kCdf44 two before and one after.
//   fine_m     kCdf22: (2 width - 1) * (2 height - 1); kCdf44: (2 width - 5) * (2 height - 5), from coarse post (1, 1) on
void inverse_region(WaveletBasis basis, const float* coarse_m, int width, int height, std::array<const float*, 3> detail, int stride,
                    int lead, std::vector<float>& fine_m);

}  // namespace lodestone
