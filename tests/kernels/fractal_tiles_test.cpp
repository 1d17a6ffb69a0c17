// Tiles of the fractal methods are crops of one terrain, bit for bit, on the host and on the device.

#include <gtest/gtest.h>

#include <bit>
#include <random>

#include "kernels/fractal/fractal_synthesis.h"
#include "tests/support/fractal_reference.h"
#include "tests/support/test_device.h"

namespace lodestone {
namespace {

using testing::FractalReference;
using testing::FractalWorld;

std::string describe(const FractalTask& t) {
  return "method " + std::to_string(static_cast<int>(t.method)) + " depth " + std::to_string(t.depth) +
         " posts " + std::to_string(t.posts) + " at " + std::to_string(t.x0) + "," + std::to_string(t.y0) +
         " world " + std::to_string(t.world.width()) + "x" + std::to_string(t.world.height()) + " from " +
         std::to_string(t.world.i0) + "," + std::to_string(t.world.j0) + " lookup " +
         std::to_string(static_cast<int>(t.parameters.lookup)) + (t.parameters.erosion ? " erosion" : "") +
         (t.parameters.altitude ? " altitude" : "") + (t.parameters.cap_m ? " cap" : "") +
         (t.mask ? " mask" : "") + (t.void_mask ? " voids" : "");
}

bool same_bits(float a, float b) {
  return std::bit_cast<std::uint32_t>(a) == std::bit_cast<std::uint32_t>(b);
}

std::vector<float> run_one(FractalSynthesis& synthesis, const FractalTask& task) {
  std::vector<std::vector<float>> out(1);
  Result<void> done = synthesis.run({&task, 1}, out);
  EXPECT_TRUE(done) << done.error().message;
  return out[0];
}

struct Case {
  FractalWorld world;
  FractalTask task;
  std::mt19937 rng;
  std::int64_t pick(std::int64_t lo, std::int64_t hi) {
    return lo + static_cast<std::int64_t>(rng() % static_cast<std::uint64_t>(hi - lo + 1));
  }
};

Case random_case(FractalMethod method, std::uint32_t n, int max_depth, std::int64_t max_world) {
  Case c{{}, {}, std::mt19937(n * 3 + static_cast<unsigned>(method))};
  FractalTask& t = c.task;
  t.method = method;
  t.depth = static_cast<int>(c.pick(1, max_depth));
  t.base_level = static_cast<int>(c.pick(0, 12));
  t.seed = std::uint64_t{c.rng()} << 32 | c.rng();
  c.world = testing::random_fractal_world(n, c.pick(2, max_world), c.pick(2, max_world),
                                          static_cast<int>(c.pick(2, 4)), c.pick(-3, 70), c.pick(-3, 70));
  t.world = c.world.world;
  t.parameters.lookup = c.pick(0, 3) == 0 ? NodeLookup::kConstant : NodeLookup::kSmooth;
  if (method == FractalMethod::kFractalWavelet) {
    t.parameters.volume = static_cast<VolumeRule>(c.pick(0, 1));
    t.parameters.channel = static_cast<int>(c.pick(0, 3));
    if (c.pick(0, 2) == 0) t.parameters.altitude = AltitudeRule{550, 650, 0.25F, 1.5F};
    if (c.pick(0, 2) == 0) t.parameters.cap_m = 6.0F;
    t.parameters.erosion = c.pick(0, 1);
    if (c.pick(0, 1)) t.parameters.water_m = 580.0F;
  }
  return c;
}

class FractalTiles : public ::testing::TestWithParam<FractalMethod> {};

TEST_P(FractalTiles, AreCropsOfTheWholeWorldWrittenDownTwice) {
  const auto host = make_host_fractal_synthesis();
  int compared = 0;
  for (std::uint32_t n = 0; n < 250; ++n) {
    Case c = random_case(GetParam(), n, 4, n % 5 == 0 ? 24 : 9);
    FractalTask& t = c.task;
    testing::RefGrid whole = FractalReference(c.world, t).run();
    t.posts = static_cast<int>(c.pick(1, 33));
    t.x0 = c.pick(whole.i0 - t.posts / 2, whole.i1);
    t.y0 = c.pick(whole.j0 - t.posts / 2, whole.j1);
    c.world.fill(t);
    const std::vector<float> tile = run_one(*host, t);
    for (std::int64_t j = 0; j < t.posts; ++j) {
      for (std::int64_t i = 0; i < t.posts; ++i) {
        const float got = tile[static_cast<std::size_t>(j * t.posts + i)];
        ASSERT_TRUE(std::isfinite(got)) << n << ": " << describe(t);
        if (!whole.has(t.x0 + i, t.y0 + j)) continue;
        ASSERT_TRUE(same_bits(got, whole.at(t.x0 + i, t.y0 + j)))
            << n << ": " << describe(t) << " post " << i << "," << j << ": " << got << " not "
            << whole.at(t.x0 + i, t.y0 + j);
        ++compared;
      }
    }
  }
  EXPECT_GT(compared, 20000);
}

TEST_P(FractalTiles, AgreeWithLargerTilesAtAnyDepth) {
  const auto host = make_host_fractal_synthesis();
  int compared = 0;
  for (std::uint32_t n = 0; n < 200; ++n) {
    Case c = random_case(GetParam(), 1000 + n, 16, 40);
    FractalTask big = c.task;
    big.posts = 49;
    const PostWindow w = finer(big.world, big.depth);
    // every third on a corner of the world
    big.x0 = n % 3 == 0 ? w.i0 - 8 : c.pick(w.i0, w.i1) & ~std::int64_t{1};
    big.y0 = n % 3 == 0 ? w.j1 - 40 : c.pick(w.j0, w.j1);
    c.world.fill(big);
    FractalTask small = c.task;
    small.posts = static_cast<int>(c.pick(1, 20));
    small.x0 = big.x0 + c.pick(0, 48 - small.posts);
    small.y0 = big.y0 + c.pick(0, 48 - small.posts);
    c.world.fill(small);
    const std::vector<float> a = run_one(*host, big), b = run_one(*host, small);
    for (std::int64_t j = 0; j < small.posts; ++j)
      for (std::int64_t i = 0; i < small.posts; ++i) {
        if (!w.contains(small.x0 + i, small.y0 + j)) continue;
        ++compared;
        ASSERT_TRUE(
            same_bits(b[static_cast<std::size_t>(j * small.posts + i)],
                      a[static_cast<std::size_t>((j + small.y0 - big.y0) * 49 + i + small.x0 - big.x0)]))
            << n << ": " << describe(small) << " post " << i << "," << j;
      }
  }
  EXPECT_GT(compared, 5000);
}

void add_masks(Case& c) {
  FractalTask& t = c.task;
  t.mask_mode = static_cast<MaskMode>(c.pick(0, 1));
  // Pixels by a hash of their position, so that every crop agrees.
  const auto crop = [&](int level, std::uint32_t salt, bool grey) {
    const PostWindow w = mask_window(t, level);
    MaskCrop m{level, w.i0, w.j0, static_cast<int>(w.width()), static_cast<int>(w.height()), {}};
    for (std::int64_t j = w.j0; j <= w.j1; ++j)
      for (std::int64_t i = w.i0; i <= w.i1; ++i) {
        const ls_uint r = ls_philox(static_cast<ls_uint>(i), static_cast<ls_uint>(j), salt, 0, 0, 0).w0;
        m.pixels.push_back(r % 4 != 0 ? 0 : static_cast<std::uint8_t>(grey && r % 8 != 0 ? r >> 8 : 255));
      }
    return m;
  };
  t.mask = crop(static_cast<int>(c.task.seed % 5) - 2, 7, true);
  if (c.task.seed & 64) t.void_mask = crop(0, 9, false);
}

TEST_P(FractalTiles, UnderMasksAgreeWithLargerTiles) {
  const auto host = make_host_fractal_synthesis();
  int compared = 0;
  for (std::uint32_t n = 0; n < 200; ++n) {
    Case c = random_case(GetParam(), 2000 + n, 6, 30);
    Case d = c;
    FractalTask &big = c.task, &small = d.task;
    big.posts = 41;
    const PostWindow w = finer(big.world, big.depth);
    big.x0 = c.pick(w.i0 - 4, w.i1);
    big.y0 = c.pick(w.j0 - 4, w.j1);
    small.posts = 11;
    small.x0 = big.x0 + c.pick(0, 30);
    small.y0 = big.y0 + c.pick(0, 30);
    d.rng = c.rng;
    add_masks(c);
    add_masks(d);
    c.world.fill(big);
    d.world.fill(small);
    const std::vector<float> a = run_one(*host, big), b = run_one(*host, small);
    for (std::int64_t j = 0; j < 11; ++j)
      for (std::int64_t i = 0; i < 11; ++i) {
        if (!w.contains(small.x0 + i, small.y0 + j)) continue;
        ++compared;
        ASSERT_TRUE(
            same_bits(b[static_cast<std::size_t>(j * 11 + i)],
                      a[static_cast<std::size_t>((j + small.y0 - big.y0) * 41 + i + small.x0 - big.x0)]))
            << n << ": " << describe(small) << " post " << i << "," << j;
      }
  }
  EXPECT_GT(compared, 5000);
}

TEST_P(FractalTiles, HaveTheSameBitsOnTheDevice) {
  const auto device = testing::test_device();
  ASSERT_TRUE(device) << "no OpenCL device: install pocl-opencl-icd";
  auto made = make_device_fractal_synthesis(device);
  ASSERT_TRUE(made) << made.error().message;
  const auto host = make_host_fractal_synthesis();
  int compared = 0;
  for (std::uint32_t n = 0; n < 200; ++n) {
    Case c = random_case(GetParam(), 3000 + n, 16, 40);
    FractalTask& t = c.task;
    t.posts = n % 20 == 0 ? 257 : static_cast<int>(c.pick(1, 66));
    const PostWindow w = finer(t.world, t.depth);
    t.x0 = n % 3 == 0 ? w.i0 : c.pick(w.i0, w.i1);
    t.y0 = n % 3 == 0 ? w.j1 - t.posts / 2 : c.pick(w.j0, w.j1);
    if (n % 2 && t.depth < 8) add_masks(c);
    c.world.fill(t);
    const std::vector<float> a = run_one(*host, t), b = run_one(**made, t);
    for (std::int64_t j = 0; j < t.posts; ++j)
      for (std::int64_t i = 0; i < t.posts; ++i) {
        const std::size_t k = static_cast<std::size_t>(j * t.posts + i);
        if (!w.contains(t.x0 + i, t.y0 + j)) continue;
        ++compared;
        ASSERT_TRUE(same_bits(a[k], b[k]))
            << n << ": " << describe(t) << " post " << i << "," << j << ": " << a[k] << " and " << b[k];
      }
  }
  EXPECT_GT(compared, 100000);
}

TEST_P(FractalTiles, RefuseTasksThatBreakARule) {
  const auto host = make_host_fractal_synthesis();
  Case c = random_case(GetParam(), 1, 4, 9);
  c.task.posts = 9;
  c.world.fill(c.task);
  std::vector<std::vector<float>> out(1);
  const auto refused = [&](auto change) {
    FractalTask t = c.task;
    change(t);
    const Result<void> done = host->run({&t, 1}, out);
    return !done && done.error().code == ErrorCode::kInvalidArgument;
  };
  EXPECT_FALSE(refused([](FractalTask&) {}));
  EXPECT_TRUE(refused([](FractalTask& t) { t.depth = 0; }));
  EXPECT_TRUE(refused([](FractalTask& t) { t.depth = 17; }));
  EXPECT_TRUE(refused([](FractalTask& t) { t.posts = 0; }));
  EXPECT_TRUE(refused([](FractalTask& t) { t.coarse_m.pop_back(); }));
  EXPECT_TRUE(refused([](FractalTask& t) { t.nodes.nodes.clear(); }));
  EXPECT_TRUE(refused([](FractalTask& t) { t.nodes.layer_width += 1; }));
  EXPECT_TRUE(refused([](FractalTask& t) { t.world.i1 = t.world.i0; }));
  EXPECT_TRUE(refused([](FractalTask& t) { t.mask = MaskCrop{0, 0, 0, 1, 1, {0}}; }));
}

std::string method_name(const ::testing::TestParamInfo<FractalMethod>& info) {
  constexpr const char* kNames[] = {"SquareSquare", "DiamondSquare", "FractalWavelet"};
  return kNames[static_cast<std::size_t>(info.param)];
}
INSTANTIATE_TEST_SUITE_P(Methods, FractalTiles,
                         ::testing::Values(FractalMethod::kSquareSquare, FractalMethod::kDiamondSquare,
                                           FractalMethod::kFractalWavelet),
                         method_name);

}  // namespace
}  // namespace lodestone
