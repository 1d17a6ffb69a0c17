#pragma once
// The sample DEM of Debian's python-matplotlib-data: 344 rows of 403 int16 metres, in a stored zip of .npy
// files.

#include <cpl_vsi.h>

#include <cstdint>
#include <string>
#include <vector>

namespace lodestone::test {

struct SampleDem {
  int cols = 0, rows = 0;
  std::vector<float> heights_m;

  // posts * posts heights from (col, row) on; halo posts beyond the edge repeat it.
  std::vector<float> window(int col, int row, int posts, int halo = 0) const {
    std::vector<float> out;
    for (int r = row - halo; r < row + posts + halo; ++r) {
      for (int c = col - halo; c < col + posts + halo; ++c) {
        const int cc = c < 0 ? 0 : (c >= cols ? cols - 1 : c), rr = r < 0 ? 0 : (r >= rows ? rows - 1 : r);
        out.push_back(heights_m[static_cast<std::size_t>(rr * cols + cc)]);
      }
    }
    return out;
  }
};

// Empty (cols 0) when the package is missing.
inline SampleDem jacksboro() {
  SampleDem dem;
  VSILFILE* file = VSIFOpenL(
      "/vsizip/{/usr/share/matplotlib/mpl-data/sample_data/jacksboro_fault_dem.npz}/elevation.npy", "rb");
  if (file == nullptr) return dem;
  constexpr int kCols = 403, kRows = 344, kHeaderBytes = 80;
  std::vector<std::int16_t> values(kCols * kRows);
  VSIFSeekL(file, kHeaderBytes, SEEK_SET);
  if (VSIFReadL(values.data(), sizeof(std::int16_t), values.size(), file) == values.size()) {
    dem.cols = kCols;
    dem.rows = kRows;
    dem.heights_m.assign(values.begin(), values.end());
  }
  VSIFCloseL(file);
  return dem;
}

}  // namespace lodestone::test
