// Time of one tile by each fractal method, beside the wavelet synthesis (gsa) that it is compared with, on
// the OpenCL device and in the plain twin. Compare rows of one run only.

#include <benchmark/benchmark.h>

#include "kernels/fractal/fractal_synthesis.h"
#include "kernels/fractal/fractal_wavelet.h"
#include "kernels/synthesis/wavelet_synthesis.h"
#include "tests/support/fractal_reference.h"
#include "tests/support/test_device.h"

namespace lodestone {
namespace {

constexpr int kPosts = 257;
constexpr std::int64_t kWorldPosts = 1025;

const testing::FractalWorld& world() {
  static const testing::FractalWorld w = testing::random_fractal_world(1, kWorldPosts, kWorldPosts, 4);
  return w;
}

FractalTask fractal_task(FractalMethod method, int depth, bool ruled) {
  FractalTask t;
  t.method = method;
  t.depth = depth;
  t.posts = kPosts;
  t.base_level = 10;
  t.seed = 7;
  t.x0 = (std::int64_t{1} << depth) * 512;
  t.y0 = t.x0;
  t.parameters.erosion = ruled;
  world().fill(t);
  return t;
}

std::unique_ptr<FractalSynthesis> synthesis(bool on_device) {
  if (!on_device) return make_host_fractal_synthesis();
  auto device = testing::test_device();
  if (!device) return nullptr;
  auto made = make_device_fractal_synthesis(device);
  return made ? std::move(*made) : nullptr;
}

void run_fractal(benchmark::State& state, FractalMethod method, bool ruled, bool on_device) {
  const auto engine = synthesis(on_device);
  if (!engine) return state.SkipWithError("no OpenCL device");
  const FractalTask task = fractal_task(method, static_cast<int>(state.range(0)), ruled);
  std::vector<std::vector<float>> out(1);
  for (auto _ : state) {
    if (Result<void> done = engine->run({&task, 1}, out); !done)
      return state.SkipWithError(done.error().message.c_str());
    benchmark::DoNotOptimize(out[0].data());
  }
  state.SetItemsProcessed(state.iterations() * kPosts * kPosts);
}

void run_gsa(benchmark::State& state, bool on_device) {
  std::unique_ptr<WaveletSynthesis> engine = make_host_wavelet_synthesis();
  if (on_device) {
    auto device = testing::test_device();
    if (!device) return state.SkipWithError("no OpenCL device");
    auto made = make_device_wavelet_synthesis(device);
    if (!made) return state.SkipWithError(made.error().message.c_str());
    engine = std::move(*made);
  }
  WaveletTask t;
  t.world = world().world;
  t.base_level = 10;
  t.depth = static_cast<int>(state.range(0));
  t.posts = kPosts;
  t.seed = 7;
  t.x0 = t.y0 = (std::int64_t{1} << t.depth) * 512;
  t.method = WaveletMethod::kGsa;
  t.bands[0].s0 = t.bands[1].s0 = t.bands[2].s0 = 2;
  t.bands[0].q = t.bands[1].q = t.bands[2].q = 0.5F;
  const PostWindow c = coarse_window(t);
  for (std::int64_t j = c.j0; j <= c.j1; ++j)
    for (std::int64_t i = c.i0; i <= c.i1; ++i) t.coarse_m.push_back(world().at(i, j));
  std::vector<std::vector<float>> out(1);
  for (auto _ : state) {
    if (Result<void> done = engine->run({&t, 1}, out); !done)
      return state.SkipWithError(done.error().message.c_str());
    benchmark::DoNotOptimize(out[0].data());
  }
  state.SetItemsProcessed(state.iterations() * kPosts * kPosts);
}

void BM_Gsa(benchmark::State& state) { run_gsa(state, true); }
void BM_SquareSquare(benchmark::State& state) {
  run_fractal(state, FractalMethod::kSquareSquare, false, true);
}
void BM_DiamondSquare(benchmark::State& state) {
  run_fractal(state, FractalMethod::kDiamondSquare, false, true);
}
void BM_FractalWavelet(benchmark::State& state) {
  run_fractal(state, FractalMethod::kFractalWavelet, false, true);
}
void BM_FractalWaveletErosion(benchmark::State& state) {
  run_fractal(state, FractalMethod::kFractalWavelet, true, true);
}
void BM_GsaHost(benchmark::State& state) { run_gsa(state, false); }
void BM_SquareSquareHost(benchmark::State& state) {
  run_fractal(state, FractalMethod::kSquareSquare, false, false);
}
void BM_DiamondSquareHost(benchmark::State& state) {
  run_fractal(state, FractalMethod::kDiamondSquare, false, false);
}
void BM_FractalWaveletHost(benchmark::State& state) {
  run_fractal(state, FractalMethod::kFractalWavelet, false, false);
}
BENCHMARK(BM_Gsa)->ArgName("depth")->Arg(1)->Arg(4)->Arg(8)->Arg(16);
BENCHMARK(BM_SquareSquare)->ArgName("depth")->Arg(1)->Arg(4)->Arg(8)->Arg(16);
BENCHMARK(BM_DiamondSquare)->ArgName("depth")->Arg(1)->Arg(4)->Arg(8)->Arg(16);
BENCHMARK(BM_FractalWavelet)->ArgName("depth")->Arg(1)->Arg(4)->Arg(8)->Arg(16);
BENCHMARK(BM_FractalWaveletErosion)->ArgName("depth")->Arg(1)->Arg(4)->Arg(8)->Arg(16);
BENCHMARK(BM_GsaHost)->ArgName("depth")->Arg(4);
BENCHMARK(BM_SquareSquareHost)->ArgName("depth")->Arg(4);
BENCHMARK(BM_DiamondSquareHost)->ArgName("depth")->Arg(4);
BENCHMARK(BM_FractalWaveletHost)->ArgName("depth")->Arg(4);

// One level of the whole transform there and back, 1025 x 1025 posts of the finer level.
void BM_FractalReduceRefine(benchmark::State& state) {
  HeightGrid fine{world().world, world().heights, {}};
  const PostWindow coarse{0, 0, kWorldPosts / 2, kWorldPosts / 2};
  for (auto _ : state) {
    auto reduced = reduce(fine, fine.window, coarse, {});
    auto back = refine(reduced->coarse, reduced->detail, {});
    benchmark::DoNotOptimize(back->heights_m.data());
  }
  state.SetItemsProcessed(state.iterations() * kWorldPosts * kWorldPosts);
}
BENCHMARK(BM_FractalReduceRefine);

}  // namespace
}  // namespace lodestone

BENCHMARK_MAIN();
