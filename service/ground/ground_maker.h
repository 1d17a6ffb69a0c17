#pragma once
// GroundMaker: heights of any tile of any level, real or synthetic. One object per worker thread.

#include <atomic>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "kernels/device/device.h"
#include "kernels/fractal/fractal_synthesis.h"
#include "kernels/synthesis/wavelet_synthesis.h"
#include "service/config/recipe.h"
#include "service/ground/layer.h"

namespace lodestone {

enum Provenance : std::uint8_t { kSurveyed = 0, kFilled = 1, kSynthetic = 2 };

// One tile's posts, row 0 north.
struct Ground {
  int posts = 0;
  std::vector<float> heights_m;           // posts * posts
  std::vector<std::uint8_t> provenance;   // posts * posts of Provenance; posts outside the data are kFilled
  std::uint8_t provenance_bits = 0;       // bit n: some post is of Provenance n
};

struct GroundRequest {
  std::shared_ptr<const Layer> layer;
  Recipe recipe;
  std::uint64_t seed = 0;
  TileId id;
};

class GroundMaker {
 public:
  // device: null computes in plain C++ (device = "host"). Error: kDevice.
  static Result<std::unique_ptr<GroundMaker>> create(std::shared_ptr<Device> device);

  // Grounds of `requests`, in their order; tiles of equal depth share kernel launches. Each fails alone, with: kNotFound (no
  // such tile), kCorrupt, kIo, kDevice.
  std::vector<Result<Ground>> make(std::span<const GroundRequest> requests);

  // Runs one task through the kernels and drops the heights: does the device still compute?
  Result<void> probe(const WaveletTask& task);

 private:
  GroundMaker(std::unique_ptr<WaveletSynthesis> wavelet, std::unique_ptr<FractalSynthesis> fractal)
      : wavelet_(std::move(wavelet)), fractal_(std::move(fractal)) {}

  Result<Ground> make_real(const GroundRequest& request);
  std::unique_ptr<WaveletSynthesis> wavelet_;
  std::unique_ptr<FractalSynthesis> fractal_;
};

// A square of posts of a synthetic level: posts x posts from (x0, y0), global indices; posts - 1 a power of two that divides
// x0 and y0.
struct GroundArea {
  int z = 0;  // > base level
  std::int64_t x0 = 0, y0 = 0;
  int posts = 257;
};
// A wavelet task with all that it needs of the layer: coarse heights, maps, masks.
struct PreparedTask {
  WaveletTask task;
  std::vector<std::uint8_t> coarse_void;  // of coarse_window(task); empty: no voids
};
// The same for the fractal methods.
struct PreparedFractalTask {
  FractalTask task;
  std::vector<std::uint8_t> coarse_void;  // of the data posts at the corners of the area's cells
};
Result<PreparedFractalTask> prepare_fractal_task(const Layer& layer, const Recipe& recipe, std::uint64_t seed, const GroundArea& area);
// True for the fractal methods, on layers that are wide enough to have a roughness (at least 2 x 2 posts); others of them are
// refined linearly.
bool is_fractal(const Recipe& recipe, const LayerInfo& info);
Result<PreparedTask> prepare_task(const Layer& layer, const Recipe& recipe, std::uint64_t seed, const GroundArea& area);

// Heights and provenance for posts beyond the data: those of the nearest post of the data. `world`: the data's posts at the
// level of `window`.
void extend_beyond_data(const PostWindow& window, const PostWindow& world, Ground& ground);

}  // namespace lodestone
