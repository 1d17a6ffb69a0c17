// Cost of wavelet synthesis against its own ingredients: rows of one run are to be compared with each other.
//   Gaussian        bare random numbers, as many as the tile has detail coefficients (halo included)
//   Memcpy          as many bytes as the fine posts of the lifting row
//   Tile/<recipe>   one 257-post tile, 4 levels, parameters packed, kernels run, heights copied out
// Environment: LODESTONE_BENCH_DEVICE picks a device by part of its name.

#include <benchmark/benchmark.h>

#include <cstdlib>
#include <cstring>
#include <thread>

#include "kernels/device/cl_handles.h"
#include "kernels/shared/ls_random.h"
#include "kernels/shared/ls_wavelet.h"
#include "kernels/synthesis/wavelet_plan.h"
#include "kernels/synthesis/wavelet_synthesis.h"
#include "tests/support/test_device.h"
#include "tests/support/wavelet_reference.h"

namespace lodestone {
namespace {

std::shared_ptr<Device> bench_device() {
  static const std::shared_ptr<Device> device = [] {
    const char* name = std::getenv("LODESTONE_BENCH_DEVICE");
    auto opened = testing::open_test_device(64, name ? name : "");
    if (!opened) {
      std::fprintf(stderr, "%s\n", opened.error().message.c_str());
      std::exit(1);
    }
    return *opened;
  }();
  return device;
}

enum Recipe { kLinear, kGsa, kLsa, kGsaMask, kLsaMask, kGsaWhite };

WaveletTask make_task(Recipe recipe, int depth, int posts, std::uint64_t seed = 42) {
  testing::World world = testing::make_world(0, 0, 257, 257, 5);
  if (recipe == kGsaMask || recipe == kLsaMask) {
    // A white road two cells wide with gray edges, and a lake.
    testing::add_mask(world, 0, 1, 1);
    for (std::int64_t j = 0; j < 256; ++j)
      for (std::int64_t i = 0; i < 256; ++i) {
        const std::int64_t road = std::abs(i - j), lake = (i - 70) * (i - 70) + (j - 74) * (j - 74);
        world.mask[static_cast<std::size_t>(j * 256 + i)] = road == 0 || lake < 9 ? 255 : road == 1 ? 120 : 0;
      }
  }
  if (recipe == kGsaWhite) testing::add_mask(world, 0, 1, 255);
  WaveletTask task;
  task.depth = depth;
  task.posts = posts;
  task.base_level = 8;
  task.seed = seed;
  const std::int64_t cells = posts - 1, middle = (std::int64_t{64} << depth) / cells * cells;
  task.x0 = middle;
  task.y0 = middle;
  task.method = recipe == kLinear ? WaveletMethod::kLinear : recipe == kLsa || recipe == kLsaMask ? WaveletMethod::kLsa : WaveletMethod::kGsa;
  task.bands = testing::lively_bands();
  testing::crop_world(world, task);
  return task;
}

std::int64_t coefficients(const WaveletTask& task) {
  std::int64_t count = 0;
  for (const LevelPlan& level : plan_task(task).levels) count += std::int64_t{3} * level.columns * level.columns;
  return count;
}

void BM_Gaussian(benchmark::State& state) {
  const auto device = bench_device();
  const WaveletTask task = make_task(kGsa, static_cast<int>(state.range(0)), static_cast<int>(state.range(1)));
  const auto blocks = static_cast<cl_uint>((coefficients(task) + 15) / 16);
  const ClQueue queue = make_queue(device->context(), device->id());
  const ClKernel kernel = make_kernel(device->program("selftest"), "ls_gaussian_fill");
  const ClBuffer out = make_buffer(device->context(), CL_MEM_READ_WRITE, blocks * 64);
  const cl_uint stream = ls_stream(8, 1, LS_ALGO_WAVELET, 0);
  for (auto _ : state) {
    set_args(kernel.get(), out.get(), cl_uint{7}, cl_uint{9}, stream, cl_uint{1}, cl_uint{2}, blocks);
    launch(queue.get(), kernel.get(), 64, blocks, 1);
    LS_CL(clFinish(queue.get()));
  }
  state.SetItemsProcessed(state.iterations() * coefficients(task));
}

void BM_Memcpy(benchmark::State& state) {
  const auto posts = static_cast<std::size_t>(state.range(0));
  std::vector<float> from(posts * posts, 1.0f), to(posts * posts);
  for (auto _ : state) {
    std::memcpy(to.data(), from.data(), from.size() * 4);
    benchmark::DoNotOptimize(to.data());
    benchmark::ClobberMemory();
  }
  state.SetBytesProcessed(state.iterations() * static_cast<std::int64_t>(from.size() * 4));
}

// One inverse step alone, to posts x posts fine heights.
void BM_InverseLifting(benchmark::State& state) {
  const auto device = bench_device();
  const auto fine = static_cast<std::size_t>(state.range(0)), coarse = (fine + 1) / 2, stride = coarse + 1;
  std::array<cl_uint, LS_HEADER_WORDS> h{};
  h[LS_H_MODE] = LS_MODE_GSA;
  h[LS_H_STRIDE] = static_cast<cl_uint>(stride);
  h[LS_H_PLANE] = static_cast<cl_uint>(stride * stride + 64);
  h[LS_H_SOURCE_STRIDE] = static_cast<cl_uint>(coarse);
  h[LS_H_OUT_STRIDE] = static_cast<cl_uint>(fine);
  const auto filled = [&](std::size_t floats) {
    ClBuffer buffer = make_buffer(device->context(), CL_MEM_READ_WRITE, floats * 4);
    return buffer;
  };
  const ClQueue queue = make_queue(device->context(), device->id());
  const ClBuffer parameters = filled(LS_HEADER_WORDS), source = filled(coarse * coarse + 64), detail = filled(3 * (stride * stride + 64)),
                 out = filled(fine * fine + 64);
  LS_CL(clEnqueueWriteBuffer(queue.get(), parameters.get(), CL_TRUE, 0, sizeof(h), h.data(), 0, nullptr, nullptr));
  const std::vector<float> values(3 * (stride * stride + 64), 1.5f);
  LS_CL(clEnqueueWriteBuffer(queue.get(), source.get(), CL_TRUE, 0, coarse * coarse * 4, values.data(), 0, nullptr, nullptr));
  LS_CL(clEnqueueWriteBuffer(queue.get(), detail.get(), CL_TRUE, 0, values.size() * 4, values.data(), 0, nullptr, nullptr));
  const ClKernel kernel = make_kernel(device->program("lifting"), "ls_inverse22");
  const auto blocks = static_cast<cl_uint>((coarse - 1) / 16), rows = static_cast<cl_uint>(coarse), strip = static_cast<cl_uint>(state.range(1));
  for (auto _ : state) {
    set_args(kernel.get(), parameters.get(), cl_uint{0}, cl_uint{0}, source.get(), detail.get(), out.get(), rows, blocks, strip);
    launch(queue.get(), kernel.get(), 64, blocks * ((rows + strip - 1) / strip), 1);
    LS_CL(clFinish(queue.get()));
  }
  state.SetBytesProcessed(state.iterations() * static_cast<std::int64_t>(fine * fine * 4));
}

std::unique_ptr<WaveletSynthesis> make_synthesis(bool is_host) {
  if (is_host) return make_host_wavelet_synthesis();
  auto made = make_device_wavelet_synthesis(bench_device());
  if (!made) std::exit(1);
  return std::move(*made);
}

void run_tiles(benchmark::State& state, bool is_host, Recipe recipe, int depth, int posts, std::size_t batch) {
  const auto synthesis = make_synthesis(is_host);
  std::vector<WaveletTask> tasks;
  for (std::size_t n = 0; n < batch; ++n) tasks.push_back(make_task(recipe, depth, posts, 42 + n));
  std::vector<std::vector<float>> heights(batch);
  if (auto done = synthesis->run(tasks, heights); !done) state.SkipWithError(done.error().message.c_str());  // compiles what is left
  for (auto _ : state) {
    if (auto done = synthesis->run(tasks, heights); !done) state.SkipWithError(done.error().message.c_str());
    benchmark::DoNotOptimize(heights[0].data());
  }
  state.SetItemsProcessed(state.iterations() * static_cast<std::int64_t>(batch) * posts * posts);
}

void BM_Tile(benchmark::State& state, Recipe recipe) {
  run_tiles(state, false, recipe, static_cast<int>(state.range(0)), static_cast<int>(state.range(1)), static_cast<std::size_t>(state.range(2)));
}
void BM_HostTile(benchmark::State& state, Recipe recipe) {
  run_tiles(state, true, recipe, static_cast<int>(state.range(0)), static_cast<int>(state.range(1)), 1);
}
void BM_Plan(benchmark::State& state, Recipe recipe) {
  const WaveletTask task = make_task(recipe, 4, 257);
  for (auto _ : state) {
    auto ok = check_task(task);
    benchmark::DoNotOptimize(ok);
    WaveletPlan plan = plan_task(task);
    benchmark::DoNotOptimize(plan.levels.data());
  }
}

#define LS_TILE_ARGS ArgNames({"depth", "posts", "batch"})
BENCHMARK(BM_Gaussian)->ArgNames({"depth", "posts"})->Args({4, 257});
BENCHMARK_CAPTURE(BM_Tile, linear, kLinear)->LS_TILE_ARGS->Args({4, 257, 1});
BENCHMARK_CAPTURE(BM_Tile, gsa, kGsa)->LS_TILE_ARGS->Args({4, 257, 1})->Args({8, 257, 1})->Args({4, 65, 1})->Args({4, 65, 16});
BENCHMARK_CAPTURE(BM_Tile, lsa, kLsa)->LS_TILE_ARGS->Args({4, 257, 1})->Args({1, 257, 1});
BENCHMARK_CAPTURE(BM_Tile, gsa_mask, kGsaMask)->LS_TILE_ARGS->Args({4, 257, 1});
BENCHMARK_CAPTURE(BM_Tile, lsa_mask, kLsaMask)->LS_TILE_ARGS->Args({4, 257, 1});
BENCHMARK_CAPTURE(BM_Tile, gsa_white, kGsaWhite)->LS_TILE_ARGS->Args({4, 257, 1});
BENCHMARK_CAPTURE(BM_Tile, gsa_workers, kGsa)->LS_TILE_ARGS->Args({4, 257, 1})->ThreadRange(1, 2)->UseRealTime();
BENCHMARK_CAPTURE(BM_Tile, lsa_workers, kLsa)->LS_TILE_ARGS->Args({4, 257, 1})->ThreadRange(1, 2)->UseRealTime();
BENCHMARK_CAPTURE(BM_HostTile, gsa, kGsa)->ArgNames({"depth", "posts"})->Args({4, 257});
BENCHMARK_CAPTURE(BM_HostTile, lsa, kLsa)->ArgNames({"depth", "posts"})->Args({4, 257});
BENCHMARK_CAPTURE(BM_Plan, gsa, kGsa);
BENCHMARK_CAPTURE(BM_Plan, lsa, kLsa);
BENCHMARK_CAPTURE(BM_Plan, gsa_mask, kGsaMask);
BENCHMARK(BM_Memcpy)->ArgName("posts")->Arg(257)->Arg(513);
BENCHMARK(BM_InverseLifting)->ArgNames({"posts", "strip"})->Args({257, 1})->Args({257, 16})->Args({257, 33})->Args({513, 16})->Args({513, 64});

}  // namespace
}  // namespace lodestone

BENCHMARK_MAIN();
