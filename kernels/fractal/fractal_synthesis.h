#pragma once
// FractalSynthesis: turns a batch of FractalTasks into heights, on an OpenCL device or in plain C++ with the
// same bits.

#include <memory>
#include <span>
#include <vector>

#include "kernels/device/device.h"
#include "kernels/fractal/fractal_task.h"
#include "kernels/types/result.h"

namespace lodestone {

// Thread-compatible: one object per worker thread; the device context and programs behind it are shared.
class FractalSynthesis {
 public:
  virtual ~FractalSynthesis() = default;

  // heights_m[n] gets task n's posts * posts heights, row 0 north, metres, as if cropped from the whole
  // synthesised level. Posts outside the world are unspecified but finite. Errors: kInvalidArgument (a rule
  // of FractalTask broken), kDevice.
  virtual Result<void> run(std::span<const FractalTask> tasks, std::span<std::vector<float>> heights_m) = 0;
};

// The plain C++ twin (device = "host").
std::unique_ptr<FractalSynthesis> make_host_fractal_synthesis();

// The OpenCL one. Creates its own in-order queue, kernels and buffers on `device`. Errors: kDevice.
Result<std::unique_ptr<FractalSynthesis>> make_device_fractal_synthesis(std::shared_ptr<Device> device);

}  // namespace lodestone
