// Cost of the steps of ingest that touch every post: logarithm and power, one analysis step, LSA maps, their
// energy.

#include <benchmark/benchmark.h>

#include <random>

#include "kernels/synthesis/roughness.h"

namespace lodestone {
namespace {

HeightGrid terrain(std::int64_t posts) {
  HeightGrid grid{{0, 0, posts - 1, posts - 1}, {}, {}};
  std::mt19937 random(1);
  std::normal_distribution<float> height(300.0F, 40.0F);
  for (std::int64_t n = 0; n < posts * posts; ++n) grid.heights_m.push_back(height(random));
  return grid;
}

void BM_DetLog2(benchmark::State& state) {
  double x = 1.25;
  for (auto _ : state) benchmark::DoNotOptimize(x = det_log2(x + 3.5));
  state.SetItemsProcessed(state.iterations());
}
BENCHMARK(BM_DetLog2);

void BM_Analyse(benchmark::State& state) {
  const HeightGrid grid = terrain(state.range(0));
  for (auto _ : state) benchmark::DoNotOptimize(analyse(grid, grid.window, coarse_world(grid.window)));
  state.SetItemsProcessed(state.iterations() * state.range(0) * state.range(0));
}
BENCHMARK(BM_Analyse)->ArgName("posts_per_edge")->Arg(1025);

struct Maps {
  HeightGrid grid;
  std::vector<AnalysisStep> steps;
  std::array<BandFit, 3> fits;
};

Maps inputs(std::int64_t posts, bool has_voids) {
  Maps in{terrain(posts), {}, {}};
  if (has_voids) {
    in.grid.is_void.assign(in.grid.heights_m.size(), 0);
    for (std::size_t n = 0; n < in.grid.is_void.size(); n += 97) in.grid.is_void[n] = 1;
  }
  HeightGrid level = in.grid;
  for (int l = 0; l < 3; ++l) {
    in.steps.push_back(analyse(level, level.window, coarse_world(level.window)));
    level = {in.steps.back().coarse, in.steps.back().low_m, in.steps.back().low_void};
  }
  in.fits.fill(fit_band(std::vector<BandVariance>{{4, 4096}, {9, 1024}, {30, 256}}, FitWeights::kWeighted));
  return in;
}

// Items are map entries, three bands together.
void BM_LsaMaps(benchmark::State& state) {
  const Maps in = inputs(1025, state.range(1) != 0);
  LsaParameters parameters;
  parameters.window = static_cast<int>(state.range(0));
  const PostWindow all{0, 0, 1024, 1024};
  for (auto _ : state) benchmark::DoNotOptimize(lsa_maps(all, in.grid.window, in.steps, in.fits, parameters));
  state.SetItemsProcessed(state.iterations() * 3 * 512 * 512);
}
BENCHMARK(BM_LsaMaps)->ArgNames({"window", "voids"})->Args({1, 0})->Args({3, 0})->Args({7, 0})->Args({3, 1});

void BM_LsaEnergy(benchmark::State& state) {
  const Maps in = inputs(1025, false);
  const auto maps = lsa_maps({0, 0, 1024, 1024}, in.grid.window, in.steps, in.fits, {});
  for (auto _ : state) benchmark::DoNotOptimize(lsa_energy(maps));
  state.SetItemsProcessed(state.iterations() * 3 * 512 * 512);
}
BENCHMARK(BM_LsaEnergy);

}  // namespace
}  // namespace lodestone

BENCHMARK_MAIN();
