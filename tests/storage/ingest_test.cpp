// Ingest: every kind of raster in, the posts that it promises out.

#include "storage/dem/ingest.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <fstream>

#include "tests/support/rasters.h"

namespace lodestone {
namespace {

using ::testing::HasSubstr;
using testing::hills;
using testing::ingest_and_open;
using testing::options_for;
using testing::RasterSpec;
using testing::real_kernels;
using testing::Scratch;
using testing::write_raster;

const std::string kShared = LODESTONE_SHARED_DATA;

HeightGrid all_posts(const LayerStore& store) {
  auto grid = store.read_window(store.info().base_level, store.info().world);
  EXPECT_TRUE(grid) << (grid ? "" : grid.error().message);
  return grid ? *grid : HeightGrid{};
}

TEST(Ingest, KeepsEveryPostOfANativeRaster) {
  const Scratch scratch;
  RasterSpec spec{600, 523};
  spec.nodata = -9999;
  write_raster(scratch / "a.tif", spec, [](int i, int j, int) { return hills(i, j); });
  auto store = ingest_and_open(scratch.path() / "data", options_for("a", {scratch / "a.tif"}));
  ASSERT_TRUE(store) << store.error().message;
  const LayerInfo& info = (*store)->info();
  EXPECT_EQ(info.world, (PostWindow{0, 0, 599, 522}));
  EXPECT_EQ(info.base_level, 2);
  EXPECT_EQ(info.max_level(), 18);
  EXPECT_EQ(info.crs_name, "EPSG:32617");
  EXPECT_DOUBLE_EQ(info.transform[0], 500015);
  EXPECT_DOUBLE_EQ(info.transform[3], 3999985);
  EXPECT_NEAR(info.cell_x_m, 30, 0.1);
  EXPECT_NEAR(info.cell_y_m, 30, 0.1);
  EXPECT_EQ(info.void_posts, 0);
  const HeightGrid grid = all_posts(**store);
  EXPECT_TRUE(grid.is_void.empty());
  for (int j = 0; j < 523; ++j) {
    for (int i = 0; i < 600; ++i) ASSERT_EQ(grid.at(i, j), static_cast<float>(hills(i, j))) << i << "," << j;
  }
  EXPECT_EQ(info.variances.size(), 9U);  // floor(log2(522))
}

TEST(Ingest, StoresTheAnalysisLevels) {
  const Scratch scratch;
  write_raster(scratch / "a.tif", {700, 600}, [](int i, int j, int) { return hills(i, j); });
  auto store = ingest_and_open(scratch.path(), options_for("a", {scratch / "a.tif"}));
  ASSERT_TRUE(store) << store.error().message;
  HeightGrid grid = all_posts(**store);
  PostWindow world = (*store)->info().world;
  for (int z = (*store)->info().base_level - 1; z >= 0; --z) {
    const PostWindow coarse = coarse_world(world);
    AnalysisStep whole = analyse(grid, world, coarse);
    auto stored = (*store)->read_window(z, coarse);
    ASSERT_TRUE(stored) << stored.error().message;
    EXPECT_EQ(stored->heights_m, whole.low_m) << "level " << z;
    double sum = 0;
    std::int64_t count = 0;
    for (std::size_t k = 0; k < whole.detail_m[0].size(); ++k) {
      if (!whole.detail_void[0].empty() && whole.detail_void[0][k] != 0) continue;
      sum += static_cast<double>(whole.detail_m[0][k]) * static_cast<double>(whole.detail_m[0][k]);
      ++count;
    }
    const BandVariance& band =
        (*store)->info().variances[static_cast<std::size_t>((*store)->info().base_level - 1 - z)][0];
    EXPECT_EQ(band.count, count);
    EXPECT_NEAR(band.variance_m2, sum / static_cast<double>(count), 1e-9 * sum / static_cast<double>(count));
    grid = HeightGrid{coarse, whole.low_m, whole.low_void};
    world = coarse;
  }
}

TEST(Ingest, SamplesTheJacksboroDem) {
  const Scratch scratch;
  auto store = ingest_and_open(
      scratch.path(), options_for("j", {std::string(LODESTONE_SOURCE_DIR) + "/config/jacksboro.vrt"}));
  ASSERT_TRUE(store) << store.error().message;
  const LayerInfo& info = (*store)->info();
  EXPECT_EQ(info.world, (PostWindow{0, 0, 402, 343}));
  EXPECT_EQ(info.height_min_m, 236);
  EXPECT_EQ(info.height_max_m, 1076);
  EXPECT_EQ(info.void_posts, 0);
  const HeightGrid grid = all_posts(**store);
  EXPECT_EQ(grid.at(0, 0), 483.0F);
  EXPECT_EQ(grid.at(402, 343), 272.0F);
  EXPECT_NEAR(info.bounds_wgs84[0], -84.41375 + 0.5 / 1200, 1e-9);
  EXPECT_NEAR(info.bounds_wgs84[3], 36.732916667 - 0.5 / 1200, 1e-9);
}

// Fills by the definition: every surveyed post is tried.
float nearest_by_hand(const HeightGrid& grid, std::int64_t i, std::int64_t j) {
  std::int64_t best = std::numeric_limits<std::int64_t>::max();
  float height = 0;
  for (std::int64_t y = grid.window.j0; y <= grid.window.j1; ++y) {
    for (std::int64_t x = grid.window.i0; x <= grid.window.i1; ++x) {
      const std::int64_t d = (x - i) * (x - i) + (y - j) * (y - j);
      if (d < best && !grid.void_at(x, y)) {
        best = d;
        height = grid.at(x, y);
      }
    }
  }
  return height;
}

TEST(Ingest, FillsVoidsWithTheNearestSurveyedPost) {
  const Scratch scratch;
  RasterSpec spec{150, 140};
  spec.nodata = -9999;
  const auto is_void = [](int i, int j) {
    return (i > 40 && i < 90 && j > 20 && j < 100) || (i * 31 + j * 17) % 5 == 0 || j == 139;
  };
  write_raster(scratch / "a.tif", spec,
               [&](int i, int j, int) { return is_void(i, j) ? -9999 : hills(i, j); });
  IngestOptions options = options_for("a", {scratch / "a.tif"});
  options.posts_per_tile = 65;
  auto store = ingest_and_open(scratch.path(), options);
  ASSERT_TRUE(store) << store.error().message;
  const HeightGrid grid = all_posts(**store);
  std::int64_t voids = 0;
  for (int j = 0; j < 140; ++j) {
    for (int i = 0; i < 150; ++i) {
      ASSERT_EQ(grid.void_at(i, j), is_void(i, j)) << i << "," << j;
      voids += is_void(i, j) ? 1 : 0;
      ASSERT_EQ(grid.at(i, j), is_void(i, j) ? nearest_by_hand(grid, i, j) : static_cast<float>(hills(i, j)))
          << i << "," << j;
    }
  }
  EXPECT_EQ((*store)->info().void_posts, voids);
  // has_voids: exact for windows inside one tile and over several.
  const LayerStore& s = **store;
  EXPECT_TRUE(*s.has_voids({50, 30, 50, 30}));
  EXPECT_EQ(*s.has_voids({1, 1, 1, 1}), is_void(1, 1));
  EXPECT_TRUE(*s.has_voids({0, 0, 149, 139}));
}

TEST(Ingest, FillsFarVoidsAlikeInEveryTile) {
  const Scratch scratch;
  RasterSpec spec{1200, 700};
  spec.nodata = -1;
  write_raster(scratch / "a.tif", spec, [](int i, int j, int) { return i < 70 && j < 70 ? 100 + i : -1; });
  auto store = ingest_and_open(scratch.path(), options_for("a", {scratch / "a.tif"}));
  ASSERT_TRUE(store) << store.error().message;
  const HeightGrid grid = all_posts(**store);
  EXPECT_EQ(grid.at(300, 10), 169.0F);   // 231 posts away: the nearest post
  EXPECT_EQ(grid.at(1100, 10), 166.5F);  // far: the mean of the nearest block with data, columns 64..69
  EXPECT_EQ(grid.at(10, 600), 131.5F);   // below: columns 0..63 of block row 1
  EXPECT_TRUE(*(*store)->has_voids({600, 300, 600, 300}));
  // Shared posts: the column between two tiles, read through either.
  for (const std::int64_t i : {256, 512, 768, 1024}) {
    auto west = (*store)->read_window((*store)->info().base_level, {i - 1, 0, i, 699});
    auto east = (*store)->read_window((*store)->info().base_level, {i, 0, i + 1, 699});
    ASSERT_TRUE(west && east);
    for (std::int64_t j = 0; j < 700; ++j) ASSERT_EQ(west->at(i, j), east->at(i, j));
  }
}

TEST(Ingest, HandlesALayerWithoutAnyData) {
  const Scratch scratch;
  RasterSpec spec{300, 280};
  spec.nodata = 0;
  write_raster(scratch / "a.tif", spec, [](int, int, int) { return 0; });
  auto store = ingest_and_open(scratch.path(), options_for("a", {scratch / "a.tif"}));
  ASSERT_TRUE(store) << store.error().message;
  EXPECT_EQ((*store)->info().void_posts, 300 * 280);
  EXPECT_EQ((*store)->info().height_max_m, 0);
  for (const LevelVariance& level : (*store)->info().variances) EXPECT_EQ(level[0].count, 0);
}

TEST(Ingest, HandlesOnePixelAndThinRasters) {
  for (const auto& [w, h] : {std::pair{1, 1}, {1, 5}, {700, 1}, {2, 2}, {257, 257}, {258, 3}}) {
    const Scratch scratch;
    write_raster(scratch / "a.tif", {w, h}, [](int i, int j, int) { return hills(i, j); });
    auto store = ingest_and_open(scratch.path(), options_for("a", {scratch / "a.tif"}));
    ASSERT_TRUE(store) << w << " x " << h << ": " << store.error().message;
    const HeightGrid grid = all_posts(**store);
    for (int j = 0; j < h; ++j) {
      for (int i = 0; i < w; ++i) ASSERT_EQ(grid.at(i, j), static_cast<float>(hills(i, j)));
    }
    EXPECT_TRUE((*store)->info().has_tile({0, 0, 0}));
    EXPECT_FALSE((*store)->info().has_tile({0, 1, 0}));
    auto report = verify_layer(scratch.path(), "a", nullptr);
    ASSERT_TRUE(report);
    EXPECT_THAT(report->problems, ::testing::IsEmpty());
  }
}

TEST(Ingest, ReadsScaleOffsetFeetAndWrongWayRoundRasters) {
  const Scratch scratch;
  RasterSpec spec{70, 50};
  spec.type = GDT_Int16;
  spec.scale = 0.01;
  spec.offset = 200;
  spec.unit = "ft";
  spec.nodata = -32768;
  spec.transform = {500000, 30, 0, 4000000, 0, 30};  // rows run north
  write_raster(scratch / "a.tif", spec,
               [](int i, int j, int) { return i == 3 && j == 4 ? -32768 : i + 100 * j; });
  auto store = ingest_and_open(scratch.path(), options_for("a", {scratch / "a.tif"}));
  ASSERT_TRUE(store) << store.error().message;
  const HeightGrid grid = all_posts(**store);
  EXPECT_TRUE(grid.void_at(3, 45));
  EXPECT_EQ(grid.at(5, 0), static_cast<float>(((5 + 100 * 49) * 0.01 + 200) * 0.3048));
  EXPECT_DOUBLE_EQ((*store)->info().transform[3], 4000000 + 49.5 * 30);
  EXPECT_DOUBLE_EQ((*store)->info().transform[5], -30);
}

TEST(Ingest, TreatsNanInfinityAndAbsurdHeightsAsVoid) {
  const Scratch scratch;
  RasterSpec spec{64, 64};
  write_raster(scratch / "a.tif", spec, [](int i, int j, int) {
    if (j == 5 && i == 1) return std::nan("");
    if (j == 5 && i == 2) return std::numeric_limits<double>::infinity();
    if (j == 5 && i == 3) return -3.4028234663852886e38;
    return hills(i, j);
  });
  auto store = ingest_and_open(scratch.path(), options_for("a", {scratch / "a.tif"}));
  ASSERT_TRUE(store) << store.error().message;
  EXPECT_EQ((*store)->info().void_posts, 3);
  for (const float h : all_posts(**store).heights_m) ASSERT_TRUE(std::isfinite(h));
}

TEST(Ingest, ReadsTheBandAndNodataThatTheOperatorNames) {
  const Scratch scratch;
  RasterSpec spec{40, 40, 3};
  write_raster(scratch / "a.tif", spec, [](int i, int j, int b) { return b * 1000 + hills(i, j); });
  IngestOptions options = options_for("a", {scratch / "a.tif"});
  options.band = 2;
  options.nodata = 2000 + hills(7, 9);
  auto store = ingest_and_open(scratch.path(), options);
  ASSERT_TRUE(store) << store.error().message;
  const HeightGrid grid = all_posts(**store);
  EXPECT_EQ(grid.at(1, 1), static_cast<float>(2000 + hills(1, 1)));
  EXPECT_TRUE(grid.void_at(7, 9));
  options.band = 4;
  auto wrong = ingest(scratch.path(), options, real_kernels(), nullptr);
  ASSERT_FALSE(wrong);
  EXPECT_EQ(wrong.error().code, ErrorCode::kInvalidArgument);
  EXPECT_THAT(wrong.error().message, HasSubstr("bands 1 to 3"));
}

TEST(Ingest, KeepsRotatedTransforms) {
  const Scratch scratch;
  RasterSpec spec{80, 60};
  spec.transform = {386974, 27, 12, 3799860, 12, -27};
  write_raster(scratch / "a.tif", spec, [](int i, int j, int) { return hills(i, j); });
  auto store = ingest_and_open(scratch.path(), options_for("a", {scratch / "a.tif"}));
  ASSERT_TRUE(store) << store.error().message;
  const auto p = (*store)->info().world_from_post((*store)->info().base_level, 10, 20);
  EXPECT_DOUBLE_EQ(p[0], 386974 + 10.5 * 27 + 20.5 * 12);
  EXPECT_DOUBLE_EQ(p[1], 3799860 + 10.5 * 12 - 20.5 * 27);
  const auto back = (*store)->info().post_from_world((*store)->info().base_level, p[0], p[1]);
  EXPECT_NEAR(back[0], 10, 1e-9);
  EXPECT_NEAR(back[1], 20, 1e-9);
  EXPECT_EQ(all_posts(**store).at(10, 20), static_cast<float>(hills(10, 20)));
}

TEST(Ingest, JoinsSourcesWithTheFirstOnTop) {
  const Scratch scratch;
  RasterSpec a{60, 50};
  a.nodata = -1;
  RasterSpec b = a;
  b.transform[0] += 40 * 30;
  b.transform[3] += 10 * 30;
  write_raster(scratch / "a.tif", a,
               [](int i, int j, int) { return i == 50 && j == 20 ? -1 : 1000 + i + j; });
  write_raster(scratch / "b.tif", b, [](int i, int j, int) { return 2000 + i + j; });
  auto store = ingest_and_open(scratch.path(), options_for("ab", {scratch / "a.tif", scratch / "b.tif"}));
  ASSERT_TRUE(store) << store.error().message;
  EXPECT_EQ((*store)->info().world, (PostWindow{0, 0, 99, 59}));
  const HeightGrid grid = all_posts(**store);
  EXPECT_EQ(grid.at(45, 15), 1000.0F + 45 + 5);   // both: the first
  EXPECT_EQ(grid.at(50, 30), 2000.0F + 10 + 30);  // the first is void there
  EXPECT_EQ(grid.at(90, 3), 2000.0F + 50 + 3);
  EXPECT_TRUE(grid.void_at(2, 2));
  // A source beside the grid is refused, with the way out.
  RasterSpec c = a;
  c.transform[0] += 7;
  write_raster(scratch / "c.tif", c, [](int, int, int) { return 1; });
  auto beside = ingest(scratch.path(), options_for("x", {scratch / "a.tif", scratch / "c.tif"}),
                       real_kernels(), nullptr);
  ASSERT_FALSE(beside);
  EXPECT_EQ(beside.error().code, ErrorCode::kInvalidArgument);
  EXPECT_THAT(beside.error().message, HasSubstr("WorldCRS84Quad"));
  c.crs = "EPSG:32618";
  write_raster(scratch / "d.tif", c, [](int, int, int) { return 1; });
  auto other = ingest(scratch.path(), options_for("x", {scratch / "a.tif", scratch / "d.tif"}),
                      real_kernels(), nullptr);
  ASSERT_FALSE(other);
  EXPECT_THAT(other.error().message, HasSubstr("EPSG:32618"));
}

TEST(Ingest, WarpsToQuadGrids) {
  const Scratch scratch;
  RasterSpec spec{200, 150};
  spec.crs = "EPSG:4326";
  spec.transform = {10, 0.001, 0, 46, 0, -0.001};
  spec.nodata = -9999;
  // A plane: any interpolation keeps it, so heights say where posts lie.
  write_raster(scratch / "a.tif", spec, [](int i, int j, int) {
    return (10 + (i + 0.5) * 0.001) * 100 + (46 - (j + 0.5) * 0.001) * 10;
  });
  for (const GridKind grid : {GridKind::kWorldCrs84Quad, GridKind::kWebMercatorQuad}) {
    IngestOptions options = options_for(std::string(to_string(grid)), {scratch / "a.tif"});
    options.grid = grid;
    auto store = ingest_and_open(scratch.path(), options);
    ASSERT_TRUE(store) << store.error().message;
    const LayerInfo& info = (*store)->info();
    EXPECT_EQ(info.world.i0 % 256, 0);
    EXPECT_EQ(info.world.j1 % 256, 0);
    const bool is_geographic = grid == GridKind::kWorldCrs84Quad;
    if (is_geographic) {
      EXPECT_EQ(info.base_level, 10);  // 180 / 256 / 2^10 = 0.000687 <= 0.001 < twice that
      EXPECT_DOUBLE_EQ(info.transform[1], 180.0 / 256 / 1024);
    }
    EXPECT_FALSE(info.has_tile({info.base_level, 0, 0}));
    EXPECT_TRUE(info.has_tile({0, is_geographic ? 1 : 0, 0}));
    const HeightGrid posts = all_posts(**store);
    std::int64_t surveyed = 0;
    for (std::int64_t j = info.world.j0; j <= info.world.j1; ++j) {
      for (std::int64_t i = info.world.i0; i <= info.world.i1; ++i) {
        if (posts.void_at(i, j)) continue;
        ++surveyed;
        auto p = info.world_from_post(info.base_level, static_cast<double>(i), static_cast<double>(j));
        if (!is_geographic)
          p = {p[0] / 20037508.342789244 * 180,
               (2 * std::atan(std::exp(p[1] / 6378137)) - M_PI / 2) * 180 / M_PI};
        if (p[0] < 10.003 || p[0] > 10.197 || p[1] > 45.997 || p[1] < 45.853) continue;
        ASSERT_NEAR(posts.at(i, j), p[0] * 100 + p[1] * 10, 5e-3) << i << "," << j;
      }
    }
    EXPECT_GT(surveyed, 200 * 150);
    EXPECT_EQ(surveyed + info.void_posts, info.world.width() * info.world.height());
  }
}

TEST(Ingest, GivesTheSameBytesWithAnyNumberOfThreads) {
  const Scratch scratch;
  RasterSpec spec{900, 800};
  spec.nodata = -1;
  write_raster(scratch / "a.tif", spec,
               [](int i, int j, int) { return (i / 90 + j / 70) % 4 == 0 ? -1 : hills(i, j); });
  std::vector<LayerInfo> infos;
  for (const int threads : {1, 2, 7}) {
    IngestOptions options = options_for("a", {scratch / "a.tif"});
    options.threads = threads;
    auto info = ingest(scratch.path(), options, real_kernels(), nullptr);
    ASSERT_TRUE(info) << info.error().message;
    infos.push_back(*info);
  }
  EXPECT_EQ(layer_info_json(infos[0]), layer_info_json(infos[1]));
  EXPECT_EQ(layer_info_json(infos[0]), layer_info_json(infos[2]));
}

TEST(Ingest, TakesTheFilesOfTheWild) {
  // Generated look-alikes are above; these are real ones where a developer has them, else the packaged sample
  // twice over.
  struct Case {
    std::string file;
    int band;
  };
  std::vector<Case> cases = {{std::string(LODESTONE_SOURCE_DIR) + "/config/jacksboro.vrt", 1}};
  if (std::filesystem::exists(kShared)) {
    for (const char* name : {"awkward/bigtujunga_rotated.tif", "awkward/gabilan_int16_scale_offset.tif",
                             "awkward/meghalaya_50m_int16_nonsquare.tif", "awkward/mongon_multiband_nan.tif",
                             "awkward/rmnp_dem_nonsquare.tif", "autzen/autzen_dsm_3ft.tif",
                             "spearfish/sfdem.tif", "rainier/N46W122_srtm3.tif", "coast/N43E007.hgt",
                             "canberra/S36E149_srtm3.tif", "portland/portland_ned.tif"}) {
      cases.push_back({kShared + "/" + name, 1});
    }
  }
  const Scratch scratch;
  GDALAllRegister();
  for (const Case& c : cases) {
    for (const GridKind grid : {GridKind::kNative, GridKind::kWebMercatorQuad}) {
      IngestOptions options = options_for("a", {c.file});
      options.grid = grid;
      auto store = ingest_and_open(scratch.path(), options);
      ASSERT_TRUE(store) << c.file << ": " << store.error().message;
      const LayerInfo& info = (*store)->info();
      EXPECT_GT(info.height_max_m, info.height_min_m) << c.file;
      EXPECT_LT(info.height_max_m, 4500) << c.file;
      EXPECT_GT(info.height_min_m, -100) << c.file;
      auto report = verify_layer(scratch.path(), "a", nullptr);
      ASSERT_TRUE(report) << report.error().message;
      EXPECT_THAT(report->problems, ::testing::IsEmpty()) << c.file;
      if (grid != GridKind::kNative) continue;
      // Post by post against GDAL's own reading, in metres.
      GDALDataset* d = GDALDataset::Open(c.file.c_str());
      ASSERT_NE(d, nullptr);
      GDALRasterBand* band = d->GetRasterBand(c.band);
      const double unit = std::string(band->GetUnitType()) == "ft" ? 0.3048 : 1;
      std::vector<float> row(static_cast<std::size_t>(band->GetXSize()));
      const HeightGrid grid_posts = all_posts(**store);
      ASSERT_EQ(info.world.width(), band->GetXSize());
      ASSERT_EQ(info.world.height(), band->GetYSize());
      int has = 0;
      const auto nodata = static_cast<float>(band->GetNoDataValue(&has));
      for (int j = 0; j < band->GetYSize(); ++j) {
        ASSERT_EQ(band->RasterIO(GF_Read, 0, j, band->GetXSize(), 1, row.data(), band->GetXSize(), 1,
                                 GDT_Float32, 0, 0),
                  CE_None);
        for (int i = 0; i < band->GetXSize(); ++i) {
          const float raw = row[static_cast<std::size_t>(i)];
          const bool is_void = std::isnan(raw) || (has != 0 && raw == nodata);
          ASSERT_EQ(grid_posts.void_at(i, j), is_void) << c.file << " " << i << "," << j;
          if (is_void) continue;
          ASSERT_EQ(
              grid_posts.at(i, j),
              static_cast<float>((static_cast<double>(raw) * band->GetScale() + band->GetOffset()) * unit))
              << c.file;
        }
      }
      GDALClose(d);
    }
  }
}

TEST(Ingest, JoinsNeighbouringSrtmTiles) {
  const Scratch scratch;
  std::vector<std::string> sources = {kShared + "/andorra/N42E001.hgt", kShared + "/andorra/N41E001.hgt"};
  if (!std::filesystem::exists(sources[0])) {
    // Two tiles of the same make: 1201 x 1201, one row shared.
    for (const int north : {43, 42}) {
      RasterSpec spec{1201, 1201};
      spec.crs = "EPSG:4326";
      spec.type = GDT_Int16;
      spec.transform = {1 - 0.5 / 1200, 1.0 / 1200, 0, north + 0.5 / 1200, 0, -1.0 / 1200};
      const std::string path = scratch / ("n" + std::to_string(north) + ".tif");
      write_raster(path, spec,
                   [north](int i, int j, int) { return std::floor(hills(i, j + (43 - north) * 1200)); });
      sources[static_cast<std::size_t>(43 - north)] = path;
    }
  }
  auto store = ingest_and_open(scratch.path(), options_for("andorra", sources));
  ASSERT_TRUE(store) << store.error().message;
  EXPECT_EQ((*store)->info().world, (PostWindow{0, 0, 1200, 2400}));
  EXPECT_EQ((*store)->info().base_level, 4);
}

TEST(Ingest, RefusesWhatIsNotADem) {
  const Scratch scratch;
  const auto refused = [&](const std::string& path) {
    auto info = ingest(scratch.path(), options_for("x", {path}), real_kernels(), nullptr);
    EXPECT_FALSE(info) << path;
    return info ? Error{} : info.error();
  };
  RasterSpec spec{20, 20};
  spec.has_transform = false;
  spec.crs = "";
  spec.driver = "PNG";
  {
    RasterSpec tif = spec;
    tif.driver = "GTiff";
    tif.type = GDT_Byte;
    write_raster(scratch / "plain.tif", tif, [](int, int, int) { return 1; });
    GDALDataset* from = GDALDataset::Open((scratch / "plain.tif").c_str());
    GDALDataset* to = GetGDALDriverManager()->GetDriverByName("PNG")->CreateCopy(
        (scratch / "plain.png").c_str(), from, 0, nullptr, nullptr, nullptr);
    GDALClose(to);
    GDALClose(from);
  }
  Error e = refused(scratch / "plain.png");
  EXPECT_EQ(e.code, ErrorCode::kUnsupported);
  EXPECT_THAT(e.message, HasSubstr("gdal_translate -a_srs"));
  EXPECT_EQ(refused(scratch / "none.tif").code, ErrorCode::kNotFound);
  EXPECT_EQ(refused("/vsicurl/http://127.0.0.1:1/a.tif").code, ErrorCode::kUnsupported);
  EXPECT_EQ(refused("/vsizip/vsicurl/http://127.0.0.1:1/a.zip/a.tif").code, ErrorCode::kUnsupported);

  RasterSpec complex{20, 20};
  complex.type = GDT_CFloat32;
  write_raster(scratch / "complex.tif", complex, [](int, int, int) { return 1; });
  EXPECT_EQ(refused(scratch / "complex.tif").code, ErrorCode::kUnsupported);
  RasterSpec palette{20, 20};
  palette.type = GDT_Byte;
  palette.is_palette = true;
  write_raster(scratch / "palette.tif", palette, [](int, int, int) { return 1; });
  e = refused(scratch / "palette.tif");
  EXPECT_EQ(e.code, ErrorCode::kUnsupported);
  EXPECT_THAT(e.message, HasSubstr("colour table"));
  RasterSpec lost{20, 20};
  lost.crs = "";
  write_raster(scratch / "lost.tif", lost, [](int, int, int) { return 1; });
  EXPECT_THAT(refused(scratch / "lost.tif").message, HasSubstr("coordinate reference system"));

  // A VRT under another name must not be followed: it could read any file of this machine.
  std::ifstream in(std::string(LODESTONE_SOURCE_DIR) + "/config/jacksboro.vrt");
  std::ofstream(scratch / "sly.tif") << in.rdbuf();
  EXPECT_EQ(refused(scratch / "sly.tif").code, ErrorCode::kUnsupported);

  // A small file that declares more than anyone can want.
  RasterSpec bomb{(1 << 24) + 256, 300};
  bomb.options = {"SPARSE_OK=TRUE", "TILED=YES", "COMPRESS=DEFLATE"};
  write_raster(scratch / "bomb.tif", bomb, nullptr);
  EXPECT_EQ(refused(scratch / "bomb.tif").code, ErrorCode::kTooLarge);
  EXPECT_THAT(list_layers(scratch.path()), ::testing::IsEmpty());
}

TEST(Ingest, SurvivesTruncatedAndFlippedFiles) {
  const Scratch scratch;
  RasterSpec spec{300, 200};
  spec.options = {"COMPRESS=DEFLATE", "TILED=YES"};
  write_raster(scratch / "good.tif", spec, [](int i, int j, int) { return hills(i, j); });
  std::ifstream in(scratch / "good.tif", std::ios::binary);
  const std::string good((std::istreambuf_iterator<char>(in)), {});
  ASSERT_GT(good.size(), 1000U);
  std::uint32_t random = 12345;
  const auto next = [&random] { return random = random * 1664525U + 1013904223U; };
  int failed = 0;
  for (int n = 0; n < 120; ++n) {
    std::string bad = good;
    if (n < 40) bad.resize(good.size() * static_cast<std::size_t>(n) / 40);
    for (int flips = n < 40 ? 0 : 1 + n % 4; flips > 0; --flips) {
      const std::size_t at = n % 3 == 0 ? next() >> 8 : next() >> 8 & 0x3FF;  // anywhere, or in the header
      bad[at % bad.size()] ^= static_cast<char>(1 << (next() >> 29));
    }
    std::ofstream(scratch / "bad.tif", std::ios::binary) << bad;
    auto info = ingest(scratch.path(), options_for("x", {scratch / "bad.tif"}), real_kernels(), nullptr);
    if (info) continue;
    ++failed;
    EXPECT_FALSE(info.error().message.empty());
  }
  EXPECT_GT(failed, 40);
}

}  // namespace
}  // namespace lodestone
