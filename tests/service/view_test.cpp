// Laws of view selection on a real layer: nothing visible left out, no overlap, balance, error bound.

#include "service/view/view_selection.h"

#include <gtest/gtest.h>

#include <cmath>
#include <random>
#include <set>

#include "tests/support/layers.h"

namespace lodestone {
namespace {

class View : public ::testing::Test {
 protected:
  void SetUp() override {
    layer_ = dir_.ingest_and_open({"jacksboro", {LODESTONE_SOURCE_DIR "/config/jacksboro.vrt"}});
    ASSERT_TRUE(layer_);
    bounds_ = std::make_unique<HeightBounds>(layer_);
  }

  // A camera 20..4000 m above a random place of the data, looking anywhere but the sky.
  Camera random_camera() {
    const LayerInfo& info = layer_->info();
    std::uniform_real_distribution<double> unit(0, 1);
    const double i = unit(random_) * static_cast<double>(info.world.i1), j = unit(random_) * static_cast<double>(info.world.j1);
    const auto place = info.world_from_post(info.base_level, i, j);
    const double above_m = 20 * std::pow(200.0, unit(random_)), turn = 6.2831853 * unit(random_), down = -1.5 * unit(random_) + 0.1;
    auto camera = camera_from_world(*layer_, {{place[0], place[1], *bounds_->base_height_m(i, j) + above_m}, false,
                                              {std::cos(turn) * std::cos(down), std::sin(turn) * std::cos(down), std::sin(down)}});
    EXPECT_TRUE(camera);
    return *camera;
  }

  bool is_seen(const Camera& camera, const Vec3& p) const {
    for (const Vec3& n : view_planes(camera)) {
      if (n[0] * (p[0] - camera.eye_m[0]) + n[1] * (p[1] - camera.eye_m[1]) + n[2] * (p[2] - camera.eye_m[2]) < 0) return false;
    }
    return true;
  }

  ViewAnswer select(const Camera& camera, const ViewOptions& options = {}) {
    auto answer = select_view(*bounds_, recipe_, camera, options);
    EXPECT_TRUE(answer) << answer.error().message;
    return answer ? *answer : ViewAnswer{};
  }

  test::DataDir dir_;
  std::shared_ptr<const Layer> layer_;
  std::unique_ptr<HeightBounds> bounds_;
  Recipe recipe_ = fixed_recipes().at("linear");
  std::mt19937_64 random_{5};
};

bool is_in(const std::set<TileId>& tiles, TileId id) {
  for (; id.z >= 0; id = {id.z - 1, floor_shift(id.x, 1), floor_shift(id.y, 1)}) {
    if (tiles.count(id) != 0) return true;
  }
  return false;
}

TEST_F(View, CoversEveryPostThatTheCameraSeesAndNothingTwice) {
  const LayerInfo& info = layer_->info();
  const auto grid = layer_->store().read_window(info.base_level, info.world);
  ASSERT_TRUE(grid);
  int seen = 0;
  for (int n = 0; n < 100; ++n) {
    const Camera camera = random_camera();
    const ViewAnswer answer = select(camera);
    std::set<TileId> tiles;
    for (const ViewTile& tile : answer.tiles) tiles.insert(tile.id);
    ASSERT_EQ(tiles.size(), answer.tiles.size());
    for (const TileId& id : tiles) {
      ASSERT_TRUE(info.has_tile(id)) << to_string(id);
      ASSERT_FALSE(id.z > 0 && is_in(tiles, {id.z - 1, floor_shift(id.x, 1), floor_shift(id.y, 1)})) << to_string(id);
    }
    for (std::int64_t j = info.world.j0; j < info.world.j1; j += 3) {
      for (std::int64_t i = info.world.i0; i < info.world.i1; i += 3) {
        const auto xy = plane_from_post(static_cast<double>(i), static_cast<double>(j), camera.cell_x_m, camera.cell_y_m);
        if (!is_seen(camera, {xy[0], xy[1], grid->at(i, j)})) continue;
        ++seen;
        // A post on a tile's edge may be shown by any of the tiles that meet there.
        const int depth = kMaxDepth;
        bool is_covered = false;
        for (const int dy : {0, -1}) {
          for (const int dx : {0, -1}) {
            const TileId id{info.base_level + depth, ((i << depth) + dx) / info.cells_per_tile(), ((j << depth) + dy) / info.cells_per_tile()};
            is_covered = is_covered || is_in(tiles, id);
          }
        }
        // Ground that is seen from its back is hidden: only then may it be missing.
        ASSERT_TRUE(is_covered || answer.culled_facing > 0) << "camera " << n << ", post " << i << ", " << j;
      }
    }
  }
  EXPECT_GT(seen, 10000);
}

TEST_F(View, KeepsTheErrorBoundAndTheStatedIterations) {
  const LayerInfo& info = layer_->info();
  for (int n = 0; n < 100; ++n) {
    const Camera camera = random_camera();
    for (const ViewTile& tile : select(camera).tiles) {
      if (tile.id.z < info.max_level()) {
        EXPECT_LE(tile.error_px, 2) << to_string(tile.id);
      }
      EXPECT_EQ(tile.iterations, std::max(0, tile.id.z - info.base_level));
    }
  }
}

TEST_F(View, NeighboursDifferByAtMostOneLevelWhenBalanced) {
  int uneven = 0;
  for (const char* name : {"linear", "lsa", "square-square"}) {
    recipe_ = fixed_recipes().at(name);
    for (int n = 0; n < 40; ++n) {
      const Camera camera = random_camera();
      for (const bool is_balanced : {true, false}) {
        ViewOptions options;
        options.is_balanced = is_balanced;
        std::set<TileId> tiles;
        for (const ViewTile& tile : select(camera, options).tiles) tiles.insert(tile.id);
        for (const TileId& id : tiles) {
          for (const auto& [dx, dy] : {std::pair{-1, 0}, {1, 0}, {0, -1}, {0, 1}}) {
            for (int up = 2; up <= id.z; ++up) {
              const bool is_there = tiles.count({id.z - up, floor_shift(id.x + dx, up), floor_shift(id.y + dy, up)}) != 0;
              if (is_balanced) {
                EXPECT_FALSE(is_there) << to_string(id);
              }
              uneven += is_there && !is_balanced;
            }
          }
        }
      }
    }
  }
  std::cout << "[ view     ] uneven neighbours without balance: " << uneven << "\n";
}

TEST_F(View, AsksForNoFewerTilesWhenTheErrorMustBeSmaller) {
  ViewOptions options;
  options.is_balanced = false;
  for (int n = 0; n < 50; ++n) {
    const Camera camera = random_camera();
    std::size_t before = 0;
    for (const double error_px : {16.0, 8.0, 4.0, 2.0}) {
      options.max_error_px = error_px;
      const std::size_t tiles = select(camera, options).tiles.size();
      // A tile with little in view may give way to fewer than four children, but never to many fewer in all.
      EXPECT_GE(tiles + 4, before) << "camera " << n << ", " << error_px;
      before = tiles;
    }
  }
}

TEST_F(View, SaysNothingForTheSkyAndRefusesAnEyeInTheGround) {
  Camera camera = random_camera();
  camera.forward = {0, 0, 1};
  const ViewAnswer sky = select(camera);
  EXPECT_TRUE(sky.tiles.empty());
  EXPECT_GT(sky.culled_frustum, 0);
  EXPECT_EQ(sky.visible_ground_m2, 0);
  camera.eye_m[2] = -500;
  const auto inside = select_view(*bounds_, recipe_, camera, {});
  ASSERT_FALSE(inside);
  EXPECT_NE(inside.error().message.find("eye"), std::string::npos);
}

// 90 m, 60 degrees, 1024 px: SPEC-SYNTHESIS 5.6.
TEST_F(View, ProjectsAsThePaperDoes) {
  Camera camera;
  camera.cell_x_m = camera.cell_y_m = 90;
  camera.height_px = 1024;
  EXPECT_NEAR(view_error_px(layer_->info(), layer_->info().base_level, 39906.4506, camera), 2, 1e-6);
}

}  // namespace
}  // namespace lodestone
