// Tiles of the wavelet synthesis are crops of one terrain, bit for bit, on the host and on the device.

#include <gtest/gtest.h>

#include <bit>
#include <random>

#include "kernels/synthesis/wavelet_synthesis.h"
#include "tests/support/test_device.h"
#include "tests/support/wavelet_reference.h"

namespace lodestone {
namespace {

using testing::World;

std::string describe(const WaveletTask& t) {
  return "depth " + std::to_string(t.depth) + " posts " + std::to_string(t.posts) + " at " + std::to_string(t.x0) + "," + std::to_string(t.y0) +
         " method " + std::to_string(static_cast<int>(t.method)) + " basis " + std::to_string(static_cast<int>(t.basis)) + " lookup " +
         std::to_string(static_cast<int>(t.lookup)) + " mask " + (t.mask ? std::to_string(t.mask->level) : "none") + " mode " +
         std::to_string(static_cast<int>(t.mask_mode)) + (t.void_mask ? " voids" : "") + " world " + std::to_string(t.world.width()) + "x" +
         std::to_string(t.world.height());
}

bool same_bits(float a, float b) { return std::bit_cast<std::uint32_t>(a) == std::bit_cast<std::uint32_t>(b); }

std::vector<float> run_one(WaveletSynthesis& synthesis, const WaveletTask& task) {
  std::vector<std::vector<float>> out(1);
  Result<void> done = synthesis.run({&task, 1}, out);
  EXPECT_TRUE(done) << done.error().message;
  return out[0];
}

std::unique_ptr<WaveletSynthesis> device_synthesis() {
  auto device = testing::test_device();
  if (!device) return nullptr;
  auto made = make_device_wavelet_synthesis(device);
  return made ? std::move(*made) : nullptr;
}

struct Case {
  World world;
  WaveletTask task;
};

Case random_case(std::uint32_t n) {
  std::mt19937 rng(n);
  const auto pick = [&](int lo, int hi) { return lo + static_cast<int>(rng() % static_cast<unsigned>(hi - lo + 1)); };
  Case c;
  WaveletTask& t = c.task;
  t.depth = pick(1, 8);
  t.posts = (1 << pick(0, n % 8 == 0 ? 6 : 5)) + 1;
  t.base_level = pick(0, 12);
  t.method = static_cast<WaveletMethod>(pick(0, 8) == 0 ? 0 : pick(1, 2));
  t.basis = pick(0, 5) == 0 ? WaveletBasis::kCdf44 : WaveletBasis::kCdf22;
  t.lookup = pick(0, 3) == 0 ? SigmaLookup::kNearest : SigmaLookup::kSmooth;
  t.mask_mode = static_cast<MaskMode>(pick(0, 1));
  t.seed = std::uint64_t{rng()} << 32 | rng();
  t.bands = testing::lively_bands();
  // Even corners, as layers have them; the tile lies inside, across or at the border.
  c.world = testing::make_world(2 * pick(0, 40), 2 * pick(0, 40), pick(2, 40), pick(2, 40), n);
  if (pick(0, 2) != 0) testing::add_mask(c.world, pick(-2, 4), n, pick(0, 4) * (pick(0, 3) == 0 ? 60 : 1) % 250);
  if (pick(0, 3) == 0) testing::add_voids(c.world, n);
  const PostWindow fine = finer(c.world.window, t.depth);
  const std::int64_t cells = t.posts - 1;
  const auto place = [&](std::int64_t lo, std::int64_t hi) {
    const std::int64_t first = floor_shift(lo, 0) / cells, last = hi / cells;
    const int where = pick(0, 3);
    return cells * (where == 0 ? first : where == 1 ? last : first + static_cast<std::int64_t>(rng()) % (last - first + 1));
  };
  t.x0 = place(fine.i0, fine.i1);
  t.y0 = place(fine.j0, fine.j1);
  testing::crop_world(c.world, t);
  return c;
}

class RandomTiles : public ::testing::TestWithParam<std::uint32_t> {};

TEST_P(RandomTiles, EqualTheWholeTerrainAndTheDevice) {
  auto host = make_host_wavelet_synthesis();
  auto device = device_synthesis();
  ASSERT_NE(device, nullptr) << "no OpenCL device";
  int compared = 0;
  for (std::uint32_t n = GetParam() * 16; n < GetParam() * 16 + 16; ++n) {
    const Case c = random_case(n);
    const WaveletTask& t = c.task;
    const std::vector<float> tile = run_one(*host, t), other = run_one(*device, t);
    ASSERT_EQ(tile.size(), static_cast<std::size_t>(t.posts * t.posts));
    ASSERT_EQ(other.size(), tile.size());
    testing::Reference reference(c.world, t);
    const PostWindow fine = finer(c.world.window, t.depth);
    for (int j = 0; j < t.posts; ++j)
      for (int i = 0; i < t.posts; ++i) {
        const auto k = static_cast<std::size_t>(j * t.posts + i);
        ASSERT_TRUE(std::isfinite(tile[k]) && std::isfinite(other[k])) << describe(t) << " case " << n;
        if (!fine.contains(t.x0 + i, t.y0 + j)) continue;
        ++compared;
        ASSERT_TRUE(same_bits(tile[k], other[k])) << "device, case " << n << " post " << i << "," << j << ": " << tile[k] << " " << other[k] << "\n" << describe(t);
        const float expected = reference.height(t.depth, t.x0 + i, t.y0 + j);
        ASSERT_TRUE(same_bits(tile[k], expected)) << "whole terrain, case " << n << " post " << i << "," << j << ": " << tile[k] << " " << expected << "\n" << describe(t);
      }
  }
  EXPECT_GT(compared, 200);  // most tiles lie in the world
  RecordProperty("compared", compared);
}
INSTANTIATE_TEST_SUITE_P(Cases, RandomTiles, ::testing::Range(0u, 20u));

}  // namespace
}  // namespace lodestone
