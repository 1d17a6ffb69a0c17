// I2, I3 and I5 on whole layers: maps, masks and coarse posts as the daemon reads them.

#include "service/ground/ground_maker.h"

#include <gtest/gtest.h>

#include <cmath>
#include <fstream>
#include <random>

#include "tests/support/layers.h"

namespace lodestone {
namespace {

using test::DataDir;

std::vector<Recipe> wavelet_recipes() {
  const auto fixed = fixed_recipes();
  std::vector<Recipe> all = {fixed.at("linear"), fixed.at("gsa")};
  for (const int window : {1, 3, 5, 7}) {
    Recipe recipe = fixed.at("lsa");
    recipe.lsa.window = window;
    all.push_back(recipe);
  }
  all.back().lookup = SigmaLookup::kNearest;
  Recipe cubic = fixed.at("gsa");
  cubic.basis = WaveletBasis::kCdf44;
  all.push_back(cubic);
  return all;
}

std::string describe(const Recipe& recipe, std::uint64_t seed, const TileId& id) {
  return recipe_text(recipe) + "seed in force " + std::to_string(seed) + ", tile " + to_string(id);
}

class Ground : public ::testing::TestWithParam<test::SampleLayer> {
 protected:
  void SetUp() override {
    layer_ = dir_.ingest_and_open(GetParam());
    ASSERT_TRUE(layer_);
    auto device = Device::open({});
    ASSERT_TRUE(device) << device.error().message;
    auto maker = GroundMaker::create(*device);
    ASSERT_TRUE(maker) << maker.error().message;
    maker_ = std::move(*maker);
    host_ = make_host_wavelet_synthesis();
  }

  std::vector<float> tile(const Recipe& recipe, std::uint64_t seed, const TileId& id) {
    const GroundRequest request{layer_, recipe, seed, id};
    auto grounds = maker_->make(std::span(&request, 1));
    EXPECT_TRUE(grounds[0]) << grounds[0].error().message;
    return grounds[0] ? grounds[0]->heights_m : std::vector<float>();
  }

  // A random tile that exists at `depth` levels below base.
  TileId random_tile(int depth) {
    const int z = layer_->info().base_level + depth;
    const PostWindow tiles = layer_->info().tiles_at(z);
    std::uniform_int_distribution<std::int64_t> x(tiles.i0, tiles.i1);
    std::uniform_int_distribution<std::int64_t> y(tiles.j0, tiles.j1);
    return {z, x(random_), y(random_)};
  }

  DataDir dir_;
  std::shared_ptr<const Layer> layer_;
  std::unique_ptr<GroundMaker> maker_;
  std::unique_ptr<WaveletSynthesis> host_;
  std::mt19937_64 random_{20};
};

// The tile from the device against a crop of an area of 4 x 4 tiles (the whole level where it is smaller) from the plain twin.
TEST_P(Ground, EveryTileIsTheCropOfALargerSynthesis) {
  const LayerInfo& info = layer_->info();
  const int cells = info.cells_per_tile();
  int compared = 0;
  for (const Recipe& recipe : wavelet_recipes()) {
    for (int depth = 1; depth <= 8; ++depth) {
      for (int n = 0; n < 4; ++n) {
        const TileId id = random_tile(depth);
        const std::uint64_t seed = random_();
        const GroundArea area{id.z, (id.x & ~std::int64_t{3}) * cells, (id.y & ~std::int64_t{3}) * cells, 4 * cells + 1};
        auto large = prepare_task(*layer_, recipe, seed, area);
        ASSERT_TRUE(large) << large.error().message;
        std::vector<float> whole;
        ASSERT_TRUE(host_->run(std::span(&large->task, 1), std::span(&whole, 1)));
        const std::vector<float> heights = tile(recipe, seed, id);
        const PostWindow window = info.tile_window(id);
        const PostWindow world = info.world_at(id.z);
        for (std::int64_t j = std::max(window.j0, world.j0); j <= std::min(window.j1, world.j1); ++j) {
          for (std::int64_t i = std::max(window.i0, world.i0); i <= std::min(window.i1, world.i1); ++i) {
            const float expected = whole[static_cast<std::size_t>((j - area.y0) * area.posts + i - area.x0)];
            const float found = heights[static_cast<std::size_t>((j - window.j0) * window.width() + i - window.i0)];
            ASSERT_EQ(std::bit_cast<std::uint32_t>(expected), std::bit_cast<std::uint32_t>(found))
                << describe(recipe, seed, id) << ", post " << i << ", " << j << ": " << expected << " against " << found;
          }
        }
        ++compared;
      }
    }
  }
  EXPECT_GE(compared, 200);
}

TEST_P(Ground, FractalTilesAreCropsOfALargerSynthesis) {
  const LayerInfo& info = layer_->info();
  const int cells = info.cells_per_tile();
  const auto host = make_host_fractal_synthesis();
  for (const char* name : {"square-square", "diamond-square", "fractal-wavelet"}) {
    const Recipe recipe = fixed_recipes().at(name);
    for (int depth = 1; depth <= 6; ++depth) {
      const TileId id = random_tile(depth);
      const std::uint64_t seed = random_();
      const GroundArea area{id.z, (id.x & ~std::int64_t{1}) * cells, (id.y & ~std::int64_t{1}) * cells, 2 * cells + 1};
      auto large = prepare_fractal_task(*layer_, recipe, seed, area);
      ASSERT_TRUE(large) << large.error().message;
      std::vector<float> whole;
      const auto ran = host->run(std::span(&large->task, 1), std::span(&whole, 1));
      ASSERT_TRUE(ran) << ran.error().message;
      const std::vector<float> heights = tile(recipe, seed, id);
      const PostWindow window = info.tile_window(id);
      const PostWindow world = info.world_at(id.z);
      for (std::int64_t j = window.j0; j <= std::min(window.j1, world.j1); ++j) {
        for (std::int64_t i = window.i0; i <= std::min(window.i1, world.i1); ++i) {
          ASSERT_EQ(whole[static_cast<std::size_t>((j - area.y0) * area.posts + i - area.x0)],
                    heights[static_cast<std::size_t>((j - window.j0) * window.width() + i - window.i0)])
              << describe(recipe, seed, id) << ", post " << i << ", " << j;
        }
      }
    }
  }
}

// One analysis step of level z + 1 gives level z back (I3), in the middle of the data.
TEST_P(Ground, AnalysisOfAFinerLevelGivesTheCoarserOneBack) {
  const LayerInfo& info = layer_->info();
  const float highest = static_cast<float>(std::max(std::abs(info.height_min_m), std::abs(info.height_max_m)));
  for (const char* name : {"gsa", "lsa"}) {
    const Recipe recipe = fixed_recipes().at(name);
    for (int depth = 1; depth <= 3; ++depth) {
      const TileId id = random_tile(depth);
      auto fine = prepare_task(*layer_, recipe, 5, {id.z, id.x * info.cells_per_tile(), id.y * info.cells_per_tile(), info.posts_per_tile});
      ASSERT_TRUE(fine);
      std::vector<float> heights;
      ASSERT_TRUE(host_->run(std::span(&fine->task, 1), std::span(&heights, 1)));
      const PostWindow window = info.tile_window(id);
      const HeightGrid grid{window, heights, {}};
      // Coarse posts whose whole filter lies in the tile and in the data.
      const PostWindow world = info.world_at(id.z);
      PostWindow coarse{ceil_shift(std::max(window.i0, world.i0) + 2, 1), ceil_shift(std::max(window.j0, world.j0) + 2, 1),
                        floor_shift(std::min(window.i1, world.i1) - 2, 1), floor_shift(std::min(window.j1, world.j1) - 2, 1)};
      if (coarse.is_empty()) continue;
      const AnalysisStep step = analyse(grid, world, coarse);
      std::vector<float> parent;
      PostWindow parent_window{};
      if (depth == 1) {
        auto real = layer_->store().read_window(info.base_level, coarse);
        ASSERT_TRUE(real);
        parent = real->heights_m;
        parent_window = coarse;
      } else {
        const TileId above{id.z - 1, id.x >> 1, id.y >> 1};
        parent = tile(recipe, 5, above);
        parent_window = info.tile_window(above);
      }
      const float bound = static_cast<float>(depth + 1) * std::ldexp(highest, -21);
      for (std::int64_t j = coarse.j0; j <= coarse.j1; ++j) {
        for (std::int64_t i = coarse.i0; i <= coarse.i1; ++i) {
          const float expected = parent[static_cast<std::size_t>((j - parent_window.j0) * parent_window.width() + i - parent_window.i0)];
          const float found = step.low_m[static_cast<std::size_t>((j - coarse.j0) * coarse.width() + i - coarse.i0)];
          ASSERT_NEAR(expected, found, bound) << name << " " << to_string(id) << " post " << i << ", " << j;
        }
      }
    }
  }
}

TEST_P(Ground, LevelsUpToTheBaseHoldNoSyntheticEnergy) {
  const Recipe lsa = fixed_recipes().at("lsa");
  const Recipe linear = fixed_recipes().at("linear");
  for (int z = 0; z <= layer_->info().base_level; ++z) {
    const PostWindow tiles = layer_->info().tiles_at(z);
    const TileId id{z, tiles.i0, tiles.j0};
    EXPECT_EQ(tile(lsa, 1, id), tile(linear, 2, id)) << to_string(id);
  }
}

// I5: mean square of the new details per band against s0^2 q^2s of the layer's own fit, on valid ground (GSA).
TEST_P(Ground, NewDetailsHaveTheVarianceThatTheFitPredicts) {
  const LayerInfo& info = layer_->info();
  const Recipe recipe = fixed_recipes().at("gsa");
  auto model = layer_->model(LsaParameters{});
  ASSERT_TRUE(model);
  for (int depth = 1; depth <= 2; ++depth) {
    std::array<double, 3> sum{};
    std::array<std::int64_t, 3> count{};
    const PostWindow tiles = info.tiles_at(info.base_level + depth);
    for (std::int64_t y = tiles.j0; y <= tiles.j1; ++y) {
      for (std::int64_t x = tiles.i0; x <= tiles.i1 && count[0] < 400000; ++x) {
        const TileId id{info.base_level + depth, x, y};
        auto fine = prepare_task(*layer_, recipe, 99, {id.z, x * info.cells_per_tile(), y * info.cells_per_tile(), info.posts_per_tile});
        ASSERT_TRUE(fine);
        if (fine->task.void_mask) continue;
        const PostWindow window = info.tile_window(id);
        const PostWindow world = info.world_at(id.z);
        if (window.i1 > world.i1 || window.j1 > world.j1) continue;
        const HeightGrid grid{window, tile(recipe, 99, id), {}};
        const PostWindow coarse{ceil_shift(window.i0 + 2, 1), ceil_shift(window.j0 + 2, 1), floor_shift(window.i1 - 4, 1), floor_shift(window.j1 - 4, 1)};
        const AnalysisStep step = analyse(grid, world, coarse);
        for (int band = 0; band < 3; ++band) {
          for (const float d : step.detail_m[band]) sum[band] += static_cast<double>(d) * d;
          count[band] += static_cast<std::int64_t>(step.detail_m[band].size());
        }
      }
    }
    for (int band = 0; band < 3 && count[band] > 10000; ++band) {
      const BandSigma& sigma = (*model)->bands[band];
      const double predicted = 2 * std::log2(sigma.s0) + 2 * (depth - 1) * std::log2(sigma.q);
      const double found = std::log2(sum[band] / static_cast<double>(count[band]));
      const double standard_error = std::sqrt(2.0 / static_cast<double>(count[band])) / std::log(2.0);
      EXPECT_NEAR(found, predicted, 5 * standard_error + 0.03) << "band " << band << " depth " << depth;
    }
  }
}

TEST_P(Ground, HeightsAreFiniteAtEveryLevel) {
  for (const Recipe& recipe : wavelet_recipes()) {
    for (const int depth : {1, 7, 16}) {
      for (const float h : tile(recipe, 3, random_tile(depth))) ASSERT_TRUE(std::isfinite(h)) << recipe_text(recipe) << depth;
    }
  }
}

// Layers without a single cell: every recipe gives the straight line through the posts, at any depth.
TEST(ThinLayers, AreRefinedAlongTheirOnlyRowOrColumn) {
  const DataDir dir;
  auto maker = GroundMaker::create(nullptr);
  ASSERT_TRUE(maker);
  for (const auto& [columns, rows] : {std::pair(1, 1), std::pair(1, 5), std::pair(5, 1)}) {
    const std::string name = "thin" + std::to_string(columns) + "x" + std::to_string(rows);
    const std::filesystem::path raster = dir.path() / (name + ".asc");
    std::ofstream grid(raster);
    grid << "ncols " << columns << "\nnrows " << rows << "\nxllcorner 10\nyllcorner 50\ncellsize 0.001\n";
    for (int n = 0; n < columns * rows; ++n) grid << 100 + 16 * n << (columns > 1 ? ' ' : '\n');
    grid << "\n";
    grid.close();
    std::ofstream(dir.path() / (name + ".prj"))
        << "GEOGCS[\"WGS 84\",DATUM[\"WGS_1984\",SPHEROID[\"WGS 84\",6378137,298.257223563]],PRIMEM[\"Greenwich\",0],"
           "UNIT[\"degree\",0.0174532925199433]]";
    const auto layer = dir.ingest_and_open({name, {raster}});
    ASSERT_TRUE(layer);
    for (const auto& [recipe_name, recipe] : fixed_recipes()) {
      for (const int depth : {1, 3, 16}) {
        const GroundRequest request{layer, recipe, 7, {layer->info().base_level + depth, 0, 0}};
        const auto grounds = (*maker)->make(std::span(&request, 1));
        ASSERT_TRUE(grounds[0]) << recipe_name << ", " << name << ": " << grounds[0].error().message;
        const int posts = grounds[0]->posts;
        const std::int64_t last = std::int64_t{4} << depth;
        for (int n = 0; n < posts; ++n) {
          const std::int64_t along = std::min<std::int64_t>(n, last);
          const float expected = columns * rows == 1 ? 100 : 100 + std::ldexp(16.0F * static_cast<float>(along), -depth);
          const std::size_t post = columns > 1 ? static_cast<std::size_t>(n) : static_cast<std::size_t>(n) * posts;
          ASSERT_FLOAT_EQ(grounds[0]->heights_m[post], expected) << recipe_name << ", " << name << ", depth " << depth << ", post " << n;
        }
      }
    }
  }
}

INSTANTIATE_TEST_SUITE_P(Layers, Ground, ::testing::ValuesIn(test::sample_layers()),
                         [](const auto& sample) { return sample.param.name; });

}  // namespace
}  // namespace lodestone
