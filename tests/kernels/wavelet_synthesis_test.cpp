// Wavelet synthesis: vectors of the specification, edge cases, batches.

#include "kernels/synthesis/wavelet_synthesis.h"

#include <gtest/gtest.h>

#include <cmath>
#include <functional>

#include "kernels/wavelet/lifting.h"
#include "tests/support/wavelet_run.h"

namespace lodestone {
namespace {

using testing::run_both;
using testing::World;

World example_world() {
  World world = testing::make_world(0, 0, 5, 5, 1);
  world.heights_m = {100, 104, 112, 108, 96, 102, 110, 120, 114, 100, 98, 107, 125, 119, 104, 95, 101, 116, 111, 99, 90, 97, 108, 103, 94};
  return world;
}

WaveletTask example_task(const World& world, int depth, int posts) {
  WaveletTask task = testing::task_over(world, WaveletMethod::kGsa, depth, posts);
  for (std::size_t band = 0; band < 3; ++band) task.bands[band] = {band == 2 ? 1.0f : 2.0f, 0.5f, {}};
  return task;
}

TEST(Gsa, MatchesTheExampleOfTheSpecification) {
  const World world = example_world();
  const std::vector<float> one = run_both(example_task(world, 1, 9)), two = run_both(example_task(world, 2, 17));
  const std::vector<float> row0{100.084885f, 105.71499f, 103.178734f, 106.804245f, 111.527306f, 109.81183f, 107.134285f, 102.25233f, 95.375015f};
  EXPECT_EQ(std::vector<float>(one.begin(), one.begin() + 9), row0);
  EXPECT_EQ(testing::bits(two[8 * 17 + 8]), 0x42fa859fu);
  EXPECT_EQ(testing::bits(two[3 * 17 + 5]), 0x42de547du);
}

TEST(Synthesis, IsReversible) {
  const World world = testing::make_world(0, 0, 33, 33, 9);
  for (const WaveletMethod method : {WaveletMethod::kGsa, WaveletMethod::kLsa}) {
    std::vector<float> grid = run_both(testing::task_over(world, method, 3, 257));
    float highest = 0;
    for (const float h : grid) highest = std::max(highest, std::abs(h));
    for (int n = 257; n > 33; n = (n + 1) / 2) grid = forward_lifting(WaveletBasis::kCdf22, grid, n, n).low_m;
    for (std::size_t n = 0; n < grid.size(); ++n) ASSERT_NEAR(grid[n], world.heights_m[n], 4 * highest / (1 << 21));
  }
}

TEST(Synthesis, LeavesFlatGroundFlat) {
  World world = testing::make_world(0, 0, 9, 9, 2);
  world.heights_m.assign(81, 0.0f);
  for (SigmaMap& map : world.maps) map.s0.assign(map.s0.size(), 0.0f);
  WaveletTask task = testing::task_over(world, WaveletMethod::kLsa, 4, 129);
  for (BandSigma& band : task.bands) band.s0 = 0;
  for (const float h : run_both(task)) ASSERT_EQ(h, 0.0f);
  task.method = WaveletMethod::kGsa;
  for (const float h : run_both(task)) ASSERT_EQ(h, 0.0f);
}

TEST(Synthesis, TakesEverySeed) {
  const World world = testing::make_world(0, 0, 9, 9, 3);
  std::vector<std::vector<float>> seen;
  for (const std::uint64_t seed : {std::uint64_t{0}, std::uint64_t{1}, std::uint64_t{1} << 31, (std::uint64_t{1} << 63) - 1, ~std::uint64_t{0}}) {
    WaveletTask task = testing::task_over(world, WaveletMethod::kGsa, 3, 65);
    task.seed = seed;
    const std::vector<float> tile = run_both(task);
    for (const float h : tile) ASSERT_TRUE(std::isfinite(h));
    for (const auto& other : seen) EXPECT_NE(tile, other);
    seen.push_back(tile);
  }
}

TEST(Synthesis, WorksSixteenLevelsDownAtHugeIndices) {
  for (const WaveletBasis basis : {WaveletBasis::kCdf22, WaveletBasis::kCdf44}) {
    World world = testing::make_world((std::int64_t{1} << 33) + 6, (std::int64_t{1} << 34) + 2, 7, 6, 11);
    testing::add_mask(world, 0, 3, 0);
    testing::add_voids(world, 4);
    const PostWindow fine = finer(world.window, 16);
    for (const std::int64_t step : {std::int64_t{0}, std::int64_t{12345}, (fine.width() - 1) / 16 - 1}) {
      WaveletTask task = testing::task_over(world, WaveletMethod::kLsa, 16, 17, fine.i0 + 16 * step, fine.j0 + 16 * (step % 15000));
      task.basis = basis;
      testing::crop_world(world, task);
      const std::vector<float> tile = run_both(task);
      testing::Reference reference(world, task);
      for (int j = 0; j < 17; ++j)
        for (int i = 0; i < 17; ++i)
          ASSERT_EQ(testing::bits(tile[static_cast<std::size_t>(j * 17 + i)]), testing::bits(reference.height(16, task.x0 + i, task.y0 + j)))
              << step << ": " << i << "," << j;
    }
  }
}

TEST(Synthesis, GivesABatchTheBitsOfItsTiles) {
  World world = testing::make_world(0, 0, 65, 65, 12);
  std::vector<WaveletTask> tasks;
  for (int n = 0; n < 40; ++n) {
    const int depth = n < 20 ? 4 : 2 + n % 3, posts = n < 30 ? 65 : 33;
    if (n % 4 == 3) testing::add_mask(world, n % 3, static_cast<std::uint32_t>(n), n % 8 == 3 ? 255 : 0);
    else world.mask.clear();
    tasks.push_back(testing::task_over(world, static_cast<WaveletMethod>(n % 3), depth, posts, (posts - 1) * (n % 4), (posts - 1) * (n / 10)));
    tasks.back().seed = static_cast<std::uint64_t>(n) << 30;
  }
  auto device = testing::device_synthesis();
  ASSERT_NE(device, nullptr);
  std::vector<std::vector<float>> batch(tasks.size());
  const Result<void> done = device->run(tasks, batch);
  ASSERT_TRUE(done) << done.error().message;
  for (std::size_t n = 0; n < tasks.size(); ++n) EXPECT_EQ(testing::bits(batch[n]), testing::bits(run_both(tasks[n]))) << n;
}

TEST(Synthesis, NamesTheBrokenRule) {
  const World world = testing::make_world(0, 0, 9, 9, 2);
  World masked = world;
  testing::add_mask(masked, 0, 1, 0);
  const WaveletTask good = testing::task_over(masked, WaveletMethod::kLsa, 3, 33);
  const std::vector<std::pair<std::string, std::function<void(WaveletTask&)>>> faults{
      {"depth", [](WaveletTask& t) { t.depth = 17; }},
      {"depth", [](WaveletTask& t) { t.depth = 0; }},
      {"posts", [](WaveletTask& t) { t.posts = 35; }},
      {"multiples", [](WaveletTask& t) { t.x0 = 5; }},
      {"touch the world", [](WaveletTask& t) { t.x0 = 6400; }},
      {"2 x 2", [](WaveletTask& t) { t.world.i1 = t.world.i0; }},
      {"coarse_m", [](WaveletTask& t) { t.coarse_m.pop_back(); }},
      {"map of band 2", [](WaveletTask& t) { t.maps[1].q.pop_back(); }},
      {"sigma_window", [](WaveletTask& t) { t.maps[2].i0 += 1; }},
      {"mask must have", [](WaveletTask& t) { t.mask->pixels.pop_back(); }},
      {"mask_window", [](WaveletTask& t) { t.mask->j0 += 1; }},
      {"void_mask level", [](WaveletTask& t) { t.void_mask = t.mask, t.void_mask->level = 1; }},
      {"2^52", [](WaveletTask& t) { t.x0 = std::int64_t{1} << 60; }},
  };
  const auto host = make_host_wavelet_synthesis();
  const auto device = testing::device_synthesis();
  ASSERT_NE(device, nullptr);
  for (const auto& [word, fault] : faults) {
    WaveletTask task = good;
    fault(task);
    for (WaveletSynthesis* synthesis : {host.get(), device.get()}) {
      std::vector<std::vector<float>> out(1);
      Result<void> done = synthesis->run({&task, 1}, out);
      ASSERT_FALSE(done) << word;
      EXPECT_EQ(done.error().code, ErrorCode::kInvalidArgument);
      EXPECT_NE(done.error().message.find(word), std::string::npos) << done.error().message;
    }
  }
}

}  // namespace
}  // namespace lodestone
