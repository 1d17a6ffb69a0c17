#pragma once
// WaveletSynthesis: turns a batch of WaveletTasks into heights, on an OpenCL device or in plain C++ with the same bits.

#include <memory>
#include <span>
#include <vector>

#include "kernels/device/device.h"
#include "kernels/synthesis/wavelet_task.h"
#include "kernels/types/result.h"

namespace lodestone {

// Thread-compatible: one object per worker thread; the device context and programs behind it are shared.
class WaveletSynthesis {
 public:
  virtual ~WaveletSynthesis() = default;

  // heights_m[n] gets task n's posts * posts heights, row 0 north, metres, as if cropped from the whole synthesised level.
  // Posts outside the world are unspecified but finite. Tasks may differ in everything; equal (depth, posts, basis)
  // neighbours share kernel launches. Errors: kInvalidArgument (a rule of WaveletTask broken), kDevice.
  virtual Result<void> run(std::span<const WaveletTask> tasks, std::span<std::vector<float>> heights_m) = 0;
};

// The plain C++ twin (device = "host").
std::unique_ptr<WaveletSynthesis> make_host_wavelet_synthesis();

// The OpenCL one. Creates its own in-order queue, kernels and buffers on `device`. Errors: kDevice.
Result<std::unique_ptr<WaveletSynthesis>> make_device_wavelet_synthesis(std::shared_ptr<Device> device);

}  // namespace lodestone
