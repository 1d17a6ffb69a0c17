// kernel_digest [full|tiny] [host | part of a device's name]
// Prints one line per fixed tile and a digest of all: equal lines on every device, driver and machine. With `host`, the plain C++ twin.

#include <cstdio>
#include <cstring>

#include "kernels/synthesis/wavelet_synthesis.h"
#include "tests/support/test_device.h"
#include "tests/support/wavelet_reference.h"

using namespace lodestone;

int main(int argc, char** argv) {
  const bool is_tiny = argc > 1 && std::strcmp(argv[1], "tiny") == 0;
  const std::string name = argc > 2 ? argv[2] : "";
  std::unique_ptr<WaveletSynthesis> synthesis;
  if (name == "host") {
    synthesis = make_host_wavelet_synthesis();
  } else {
    auto device = testing::open_test_device(64, name);
    if (!device) return std::fprintf(stderr, "%s\n", device.error().message.c_str()), 1;
    std::fprintf(stderr, "%s\n", (*device)->description().name.c_str());
    auto made = make_device_wavelet_synthesis(*device);
    if (!made) return std::fprintf(stderr, "%s\n", made.error().message.c_str()), 1;
    synthesis = std::move(*made);
  }
  std::uint64_t all = 0xcbf29ce484222325ull;
  const auto add = [](std::uint64_t& hash, std::uint32_t word) {
    for (int n = 0; n < 4; ++n, word >>= 8) hash = (hash ^ (word & 255u)) * 0x100000001b3ull;
  };
  for (const WaveletMethod method : {WaveletMethod::kLinear, WaveletMethod::kGsa, WaveletMethod::kLsa})
    for (const WaveletBasis basis : {WaveletBasis::kCdf22, WaveletBasis::kCdf44})
      for (const int mask_kind : {-1, 0, 2}) {
        if (is_tiny && (method == WaveletMethod::kLinear || mask_kind == 2)) continue;
        const int posts = is_tiny ? 17 : 129, depth = is_tiny ? 2 : 3;
        testing::World world = testing::make_world(0, 0, 33, 33, 5);
        if (mask_kind >= 0) testing::add_mask(world, mask_kind, 9, mask_kind);
        if (mask_kind == 2) testing::add_voids(world, 3);
        WaveletTask task;
        task.base_level = 8;
        task.depth = depth;
        task.posts = posts;
        task.seed = 0x0123456789abcdefull;
        task.method = method;
        task.basis = basis;
        task.bands = testing::lively_bands();
        task.mask_mode = mask_kind == 2 ? MaskMode::kProtect : MaskMode::kAbsorb;
        testing::crop_world(world, task);
        std::vector<std::vector<float>> out(1);
        if (auto done = synthesis->run({&task, 1}, out); !done) return std::fprintf(stderr, "%s\n", done.error().message.c_str()), 1;
        std::uint64_t hash = 0xcbf29ce484222325ull;
        for (const float h : out[0]) {
          std::uint32_t word;
          std::memcpy(&word, &h, 4);
          add(hash, word);
          add(all, word);
        }
        std::printf("method %d basis %d mask %d: %016llx\n", static_cast<int>(method), static_cast<int>(basis), mask_kind, static_cast<unsigned long long>(hash));
      }
  std::printf("all: %016llx\n", static_cast<unsigned long long>(all));
  return 0;
}
