// Greedy TIN of one tile: time per tile, triangles kept.

#include <benchmark/benchmark.h>

#include "kernels/mesh/tin.h"
#include "tests/support/terrain.h"

namespace lodestone {
namespace {

void triangulate(benchmark::State& state, TinCriterion criterion) {
  const auto posts = static_cast<int>(state.range(0));
  const std::vector<float> heights = test::heights_of(test::Kind::kInteger, 0, 0, posts, posts, 0, 1);
  TinRequest request;
  request.field = {heights, {}, posts, posts, 0};
  request.criterion = criterion;
  if (state.range(1) > 0) {
    request.max_error_m = static_cast<double>(state.range(1));
  } else {
    request.edge_error_m = 10;
    request.max_triangles = static_cast<std::size_t>(-state.range(1));
  }
  std::size_t triangles = 0;
  double rms = 0;
  for (auto _ : state) {
    Result<TinMesh> mesh = build_tin(request);
    triangles = mesh->triangle_count();
    rms = mesh->rms_error_m;
    benchmark::DoNotOptimize(mesh);
  }
  state.counters["triangles"] = static_cast<double>(triangles);
  state.counters["rms_m"] = rms;
  state.SetItemsProcessed(state.iterations() * posts * posts);
}
void BM_DataDependent(benchmark::State& state) { triangulate(state, TinCriterion::kDataDependent); }
void BM_Delaunay(benchmark::State& state) { triangulate(state, TinCriterion::kDelaunay); }

// Second argument: error bound in metres, or minus a triangle budget.
BENCHMARK(BM_DataDependent)
    ->ArgNames({"posts", "bound"})
    ->ArgsProduct({{257, 513}, {5, 15, 40, -2000}})
    ->Unit(benchmark::kMillisecond);
BENCHMARK(BM_Delaunay)
    ->ArgNames({"posts", "bound"})
    ->ArgsProduct({{257, 513}, {5, 15, 40, -2000}})
    ->Unit(benchmark::kMillisecond);

}  // namespace
}  // namespace lodestone

BENCHMARK_MAIN();
