#pragma once
// Both implementations of the wavelet synthesis, run on one task.

#include <gtest/gtest.h>

#include <bit>

#include "kernels/synthesis/wavelet_synthesis.h"
#include "tests/support/test_device.h"
#include "tests/support/wavelet_reference.h"

namespace lodestone::testing {

inline std::uint32_t bits(float value) { return std::bit_cast<std::uint32_t>(value); }

inline std::vector<std::uint32_t> bits(const std::vector<float>& values) {
  std::vector<std::uint32_t> out;
  for (const float v : values) out.push_back(bits(v));
  return out;
}

inline std::unique_ptr<WaveletSynthesis> device_synthesis() {
  const auto device = test_device();
  if (!device) return nullptr;
  auto made = make_device_wavelet_synthesis(device);
  return made ? std::move(*made) : nullptr;
}

inline std::vector<float> run_on(WaveletSynthesis& synthesis, const WaveletTask& task) {
  std::vector<std::vector<float>> out(1);
  const Result<void> done = synthesis.run({&task, 1}, out);
  EXPECT_TRUE(done) << done.error().message;
  return out[0];
}

// The host's heights, after checking that the device's have the same bits.
inline std::vector<float> run_both(const WaveletTask& task) {
  const auto device = device_synthesis();
  EXPECT_NE(device, nullptr) << "no OpenCL device";
  const std::vector<float> heights = run_on(*make_host_wavelet_synthesis(), task);
  if (device) {
    EXPECT_EQ(bits(heights), bits(run_on(*device, task)));
  }
  return heights;
}

// A tile of `posts` posts at (x0, y0), `depth` levels below the world's level 8.
inline WaveletTask task_over(const World& world, WaveletMethod method, int depth, int posts, std::int64_t x0 = 0, std::int64_t y0 = 0) {
  WaveletTask task;
  task.base_level = 8;
  task.depth = depth;
  task.posts = posts;
  task.x0 = x0;
  task.y0 = y0;
  task.seed = 0x0123456789abcdefull;
  task.method = method;
  task.bands = lively_bands();
  crop_world(world, task);
  return task;
}

}  // namespace lodestone::testing
