// LayerInfo: levels, tiles, coordinates, JSON, names.

#include "storage/dem/layer_info.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <cstring>

#include "storage/dem/tile_codec.h"

namespace lodestone {
namespace {

using ::testing::HasSubstr;

LayerInfo layer(std::int64_t width, std::int64_t height, int base) {
  LayerInfo info;
  info.name = "a";
  info.world = {0, 0, width - 1, height - 1};
  info.base_level = base;
  info.transform = {500, 2, 0.5, 900, 0.25, -2};
  return info;
}

TEST(LayerInfo, KnowsWhichTilesExist) {
  const LayerInfo info =
      layer(514, 258, 2);  // 513 x 257 cells: the last column and row of tiles hold one cell
  EXPECT_EQ(info.tiles_at(2), (PostWindow{0, 0, 2, 1}));
  EXPECT_EQ(info.tiles_at(1), (PostWindow{0, 0, 1, 0}));
  EXPECT_EQ(info.tiles_at(0), (PostWindow{0, 0, 0, 0}));
  EXPECT_EQ(info.tiles_at(3), (PostWindow{0, 0, 4, 2}));
  EXPECT_TRUE(info.has_tile({18, 0, 0}));
  EXPECT_FALSE(info.has_tile({19, 0, 0}));
  EXPECT_FALSE(info.has_tile({-1, 0, 0}));
  EXPECT_FALSE(info.has_tile({2, -1, 0}));
  EXPECT_FALSE(info.has_tile({2, 3, 0}));
  // Every tile has its parent, and its posts some data.
  for (int z = 1; z <= 6; ++z) {
    const PostWindow t = info.tiles_at(z);
    for (std::int64_t y = t.j0; y <= t.j1; ++y) {
      for (std::int64_t x = t.i0; x <= t.i1; ++x) {
        EXPECT_TRUE(info.has_tile({z - 1, x / 2, y / 2})) << z << "/" << x << "/" << y;
        const PostWindow w = info.tile_window({z, x, y}), world = info.world_at(z);
        EXPECT_TRUE(w.i0 <= world.i1 && w.j0 <= world.j1);
      }
    }
  }
}

TEST(LayerInfo, HalvesTheWorldUpwardsAndDoublesItDownwards) {
  const LayerInfo info = layer(514, 258, 2);
  EXPECT_EQ(info.world_at(1), (PostWindow{0, 0, 256, 128}));
  EXPECT_EQ(info.world_at(0), (PostWindow{0, 0, 128, 64}));
  EXPECT_EQ(info.world_at(4), (PostWindow{0, 0, 2052, 1028}));
  LayerInfo quad = layer(257, 257, 10);
  quad.world = {256 * 1023, 256 * 5, 256 * 1024, 256 * 6};
  for (int z = 10; z >= 0; --z) {
    const PostWindow t = quad.tiles_at(z), w = quad.world_at(z);
    EXPECT_EQ(t, (PostWindow{1023 >> (10 - z), 5 >> (10 - z), 1023 >> (10 - z), 5 >> (10 - z)}));
    const PostWindow tile = quad.tile_window({z, t.i0, t.j0});
    EXPECT_TRUE(w.i0 <= tile.i1 && w.i1 >= tile.i0 && w.j0 <= tile.j1 && w.j1 >= tile.j0) << z;
  }
}

TEST(LayerInfo, TurnsPostsIntoCoordinatesAndBack) {
  const LayerInfo info = layer(514, 258, 2);
  for (const int level : {0, 2, 5}) {
    const auto p = info.world_from_post(level, 3.5, 7.25);
    const auto q = info.post_from_world(level, p[0], p[1]);
    EXPECT_NEAR(q[0], 3.5, 1e-12);
    EXPECT_NEAR(q[1], 7.25, 1e-12);
  }
  EXPECT_EQ(info.world_from_post(3, 2, 0), info.world_from_post(2, 1, 0));
}

TEST(LayerInfo, SurvivesJson) {
  LayerInfo info = layer(514, 258, 2);
  info.grid = GridKind::kWebMercatorQuad;
  info.crs_wkt = "GEOGCRS[\"x\"]";
  info.sources = {"a.tif", "b\xff.tif"};  // not UTF-8
  info.height_min_m = 0.1;
  info.void_posts = 12;
  info.variances = {{{{1.0 / 3, 5}, {2, 6}, {3, 7}}}};
  const std::string text = layer_info_json(info);
  auto back = layer_info_from_json(text);
  ASSERT_TRUE(back) << back.error().message;
  EXPECT_EQ(layer_info_json(*back), text);
  EXPECT_EQ(back->variances[0][0].variance_m2, 1.0 / 3);
  EXPECT_EQ(back->world, info.world);
  // A missing or mistyped field is named.
  std::string broken = text;
  broken.replace(broken.find("\"void_posts\""), 12, "\"void_pasts\"");
  EXPECT_THAT(layer_info_from_json(broken).error().message, HasSubstr("void_posts"));
  for (std::size_t n = 0; n < text.size(); n += 7) EXPECT_FALSE(layer_info_from_json(text.substr(0, n)));
}

TEST(Names, FollowTheRule) {
  for (const char* good : {"a", "A-1_b.c", "0"}) EXPECT_TRUE(check_name("layer", good)) << good;
  for (const char* bad : {"", ".", ".a", "a/b", "a b", "a\n", "\xc3\xa4"})
    EXPECT_FALSE(check_name("layer", bad)) << bad;
  EXPECT_TRUE(check_name("layer", std::string(64, 'a')));
  EXPECT_FALSE(check_name("layer", std::string(65, 'a')));
  EXPECT_EQ(*grid_kind_from("WorldCRS84Quad"), GridKind::kWorldCrs84Quad);
  EXPECT_FALSE(grid_kind_from("worldcrs84quad"));
}

TEST(TileValue, ComesBackBitForBit) {
  const PostWindow window{512, 256, 528, 264};
  const auto n = static_cast<std::size_t>(window.width() * window.height());
  const std::string key = tile_key({3, 2, 1});
  for (int kind = 0; kind < 5; ++kind) {
    HeightGrid tile{window, std::vector<float>(n), {}};
    for (std::size_t k = 0; k < n; ++k) {
      const auto v = static_cast<float>(k * 37 % 991);
      tile.heights_m[k] =
          kind == 0 ? 5.5F
                    : (kind == 1 ? v - 500 : (kind == 2 ? v * 0.1F : (kind == 3 ? -0.0F * v : 32768 - v)));
    }
    if (kind % 2 == 1) {
      tile.is_void.resize(n);
      for (std::size_t k = 0; k < n; ++k) tile.is_void[k] = kind == 3 || k % 5 == 0 ? 1 : 0;
    }
    const auto value = encode_tile(tile, key);
    auto back = decode_tile(value, key, window);
    ASSERT_TRUE(back) << back.error().message;
    ASSERT_EQ(std::memcmp(back->heights_m.data(), tile.heights_m.data(), n * 4), 0) << kind;
    EXPECT_EQ(back->is_void, tile.is_void);
    EXPECT_EQ(*tile_void_mode(value, key),
              kind == 3 ? VoidMode::kAll : (kind == 1 ? VoidMode::kSome : VoidMode::kNone));
    // Another place, another shape, any cut, any bit: refused.
    EXPECT_FALSE(decode_tile(value, tile_key({3, 1, 2}), window));
    EXPECT_FALSE(decode_tile(value, key, {0, 0, 16, 9}));
    for (std::size_t cut = 0; cut < value.size(); ++cut)
      EXPECT_FALSE(decode_tile({value.data(), cut}, key, window));
    for (std::size_t bit = 0; bit < value.size() * 8; bit += 3) {
      auto bad = value;
      bad[bit / 8] ^= static_cast<std::uint8_t>(1U << bit % 8);
      EXPECT_FALSE(decode_tile(bad, key, window)) << "bit " << bit;
    }
  }
}

}  // namespace
}  // namespace lodestone
