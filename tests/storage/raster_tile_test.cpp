#include "storage/formats/raster_tile.h"

#include <OpenImageIO/imageio.h>
#include <gdal_priv.h>
#include <gdal_utils.h>
#include <gtest/gtest.h>
#include <ogr_spatialref.h>
#include <unistd.h>

#include <cmath>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <limits>
#include <memory>
#include <thread>

#include "tests/support/sample_terrain.h"

namespace lodestone {
namespace {

constexpr std::array<double, 6> kRotated = {431000.5, 9.75, -2.25, 3800250.25, -2.5, -10.125};

TileAttributes sample_attributes() {
  TileAttributes a;
  a.layer = "hills";
  a.recipe = "gsa";
  a.revision = "cafe";
  a.datum = "EGM96";
  a.seed = 18446744073709551615u;
  a.z = 9;
  a.x = 210;
  a.y = 87;
  a.height_min_m = 401.5f;
  a.height_max_m = 1099.25f;
  return a;
}

std::string wkt_of(int epsg) {
  OGRSpatialReference crs;
  EXPECT_EQ(crs.importFromEPSG(epsg), OGRERR_NONE);
  char* text = nullptr;
  const char* options[] = {"FORMAT=WKT2_2019", nullptr};
  crs.exportToWkt(&text, options);
  std::string wkt = text;
  CPLFree(text);
  return wkt;
}

// Bytes as a file in GDAL's memory while the object lives.
class MemoryTiff {
 public:
  explicit MemoryTiff(std::string bytes) : bytes_(std::move(bytes)) {
    GDALAllRegister();
    VSIFCloseL(VSIFileFromMemBuffer(kPath, reinterpret_cast<GByte*>(bytes_.data()), bytes_.size(), FALSE));
    dataset_.reset(GDALDataset::Open(kPath, GDAL_OF_RASTER));
  }
  ~MemoryTiff() {
    dataset_.reset();
    VSIUnlink(kPath);
  }
  GDALDataset* get() const { return dataset_.get(); }

 private:
  static constexpr const char* kPath = "/vsimem/read_back.tif";
  std::string bytes_;
  std::unique_ptr<GDALDataset> dataset_;
};

struct Picture {
  int size = 0, channels = 0;
  std::vector<std::uint8_t> pixels;
  int at(int column, int row, int channel) const {
    return pixels[(static_cast<std::size_t>(row) * size + column) * channels + channel];
  }
};

Picture read_png(const std::string& bytes) {
  std::string path = (std::filesystem::temp_directory_path() / "lodestone_XXXXXX.png").string();
  close(mkstemps(path.data(), 4));
  std::ofstream(path, std::ios::binary) << bytes;
  Picture picture;
  if (const auto input = OIIO::ImageInput::open(path)) {
    picture = {input->spec().width, input->spec().nchannels, {}};
    EXPECT_EQ(input->spec().width, input->spec().height);
    EXPECT_EQ(input->spec().format, OIIO::TypeUInt8);
    picture.pixels.resize(static_cast<std::size_t>(picture.size) * picture.size * picture.channels);
    EXPECT_TRUE(input->read_image(0, 0, 0, picture.channels, OIIO::TypeUInt8, picture.pixels.data()));
  } else {
    ADD_FAILURE() << OIIO::geterror();
  }
  std::filesystem::remove(path);
  return picture;
}

double coded_height_m(const Picture& p, int column, int row, PngEncoding encoding) {
  const double r = p.at(column, row, 0), g = p.at(column, row, 1), b = p.at(column, row, 2);
  return encoding == PngEncoding::kTerrarium ? r * 256 + g + b / 256 - 32768 : -10000 + (r * 65536 + g * 256 + b) * 0.1;
}

TEST(F32Tile, IsTheHeightsAndNothingElse) {
  const auto heights_m = sample_terrain(257);
  const auto bytes = encode_f32_tile(heights_m);
  ASSERT_EQ(bytes.size(), 257u * 257 * 4);
  EXPECT_EQ(std::memcmp(bytes.data(), heights_m.data(), bytes.size()), 0);
  const std::vector<float> one = {1.0f};
  EXPECT_EQ(encode_f32_tile(one), std::string("\x00\x00\x80\x3f", 4));
}

TEST(TiffTile, ReadsBackThroughGdalWithItsPlaceAndItsNames) {
  const auto heights_m = sample_terrain(65);
  for (const auto& transform : {std::array<double, 6>{-84.25, 0.01, 0, 36.5, 0, -0.01}, kRotated}) {
    const bool is_geographic = transform[0] < 0;
    const auto wkt = wkt_of(is_geographic ? 4326 : 32611);
    auto encoded = encode_tiff_tile(heights_m, 65, transform, wkt, sample_attributes());
    ASSERT_TRUE(encoded) << encoded.error().message;
    const MemoryTiff tiff(*encoded);
    ASSERT_NE(tiff.get(), nullptr);
    ASSERT_EQ(tiff.get()->GetRasterXSize(), 65);
    ASSERT_EQ(tiff.get()->GetRasterCount(), 1);
    GDALRasterBand* band = tiff.get()->GetRasterBand(1);
    EXPECT_EQ(band->GetRasterDataType(), GDT_Float32);
    int has_nodata = 1;
    band->GetNoDataValue(&has_nodata);
    EXPECT_EQ(has_nodata, 0);
    std::vector<float> read(heights_m.size());
    ASSERT_EQ(band->RasterIO(GF_Read, 0, 0, 65, 65, read.data(), 65, 65, GDT_Float32, 0, 0, nullptr), CE_None);
    EXPECT_EQ(std::memcmp(read.data(), heights_m.data(), heights_m.size() * 4), 0);

    double g[6];
    ASSERT_EQ(tiff.get()->GetGeoTransform(g), CE_None);
    for (const auto& [i, j] : {std::pair{0, 0}, {64, 0}, {0, 64}, {64, 64}}) {
      const double x = g[0] + (i + 0.5) * g[1] + (j + 0.5) * g[2], y = g[3] + (i + 0.5) * g[4] + (j + 0.5) * g[5];
      EXPECT_NEAR(x, transform[0] + i * transform[1] + j * transform[2], 1e-9 * std::fabs(transform[0]));
      EXPECT_NEAR(y, transform[3] + i * transform[4] + j * transform[5], 1e-9 * std::fabs(transform[3]));
    }
    for (int k : {1, 2, 4, 5}) EXPECT_DOUBLE_EQ(g[k], transform[k]);
    ASSERT_NE(tiff.get()->GetSpatialRef(), nullptr);
    EXPECT_STREQ(tiff.get()->GetSpatialRef()->GetAuthorityCode(nullptr), is_geographic ? "4326" : "32611");
    EXPECT_STREQ(tiff.get()->GetMetadataItem("AREA_OR_POINT"), "Point");
    EXPECT_STREQ(tiff.get()->GetMetadataItem("layer"), "hills");
    EXPECT_STREQ(tiff.get()->GetMetadataItem("tile"), "9/210/87");
    EXPECT_STREQ(tiff.get()->GetMetadataItem("seed"), "18446744073709551615");
    EXPECT_STREQ(tiff.get()->GetMetadataItem("height_max_m"), "1099.25");
    EXPECT_STREQ(tiff.get()->GetMetadataItem("PREDICTOR", "IMAGE_STRUCTURE"), "3");
    EXPECT_STREQ(tiff.get()->GetMetadataItem("COMPRESSION", "IMAGE_STRUCTURE"), "DEFLATE");
    EXPECT_STREQ(band->GetUnitType(), "metre");
  }
}

TEST(TiffTile, IsTheSameFileEveryTimeAndNamesNoPathNorTime) {
  const auto heights_m = sample_terrain(33);
  auto first = encode_tiff_tile(heights_m, 33, kRotated, wkt_of(32611), sample_attributes());
  ASSERT_TRUE(first) << first.error().message;
  sleep(1);
  auto second = encode_tiff_tile(heights_m, 33, kRotated, wkt_of(32611), sample_attributes());
  ASSERT_TRUE(second);
  EXPECT_EQ(*first, *second);
  EXPECT_EQ(first->find("vsimem"), std::string::npos);
  EXPECT_EQ(MemoryTiff(*first).get()->GetMetadataItem("TIFFTAG_DATETIME"), nullptr);
}

TEST(TiffTile, ThreadsDoNotDisturbEachOther) {
  const auto heights_m = sample_terrain(33);
  const auto wkt = wkt_of(32611);
  const auto alone = encode_tiff_tile(heights_m, 33, kRotated, wkt, sample_attributes());
  ASSERT_TRUE(alone);
  std::array<int, 4> equal{};
  std::vector<std::thread> threads;
  for (int& count : equal) {
    threads.emplace_back([&] {
      for (int k = 0; k < 20; ++k) {
        const auto tile = encode_tiff_tile(heights_m, 33, kRotated, wkt, sample_attributes());
        if (tile && *tile == *alone) ++count;
      }
    });
  }
  for (auto& thread : threads) thread.join();
  for (const int count : equal) EXPECT_EQ(count, 20);
}

TEST(TiffTile, RefusesBadArguments) {
  const std::vector<float> four(4);
  EXPECT_FALSE(encode_tiff_tile(four, 3, kRotated, "", {}));
  EXPECT_FALSE(encode_tiff_tile(four, 0, kRotated, "", {}));
  auto bad_crs = encode_tiff_tile(four, 2, kRotated, "this is no WKT", {});
  ASSERT_FALSE(bad_crs);
  EXPECT_EQ(bad_crs.error().code, ErrorCode::kInvalidArgument);
  EXPECT_TRUE(encode_tiff_tile(four, 2, kRotated, "", {}));
}

class TerrainRgb : public testing::TestWithParam<PngEncoding> {};

TEST_P(TerrainRgb, DecodesWithinHalfAQuantum) {
  const double quantum_m = GetParam() == PngEncoding::kTerrarium ? 1.0 / 256 : 0.1;
  const int posts = 65, halo = 2, edge = posts + 2 * halo;
  auto heights_m = sample_terrain(edge);
  for (float& h : heights_m) h = (h - 800) * 4;  // below and above zero
  const auto post = [&](int c, int r) { return static_cast<double>(heights_m[static_cast<std::size_t>(r + halo) * edge + c + halo]); };
  for (const int size : {posts, posts - 1}) {
    auto encoded = encode_png_tile(heights_m, posts, halo, GetParam(), size, 30, 30);
    ASSERT_TRUE(encoded) << encoded.error().message;
    EXPECT_EQ(*encoded, *encode_png_tile(heights_m, posts, halo, GetParam(), size, 30, 30));
    const Picture picture = read_png(*encoded);
    ASSERT_EQ(picture.size, size);
    ASSERT_EQ(picture.channels, 3);
    for (int r = 0; r < size; ++r) {
      for (int c = 0; c < size; ++c) {
        const double expected = size == posts ? post(c, r) : (post(c, r) + post(c + 1, r) + post(c, r + 1) + post(c + 1, r + 1)) / 4;
        ASSERT_NEAR(coded_height_m(picture, c, r, GetParam()), expected, quantum_m / 2 * 1.000001) << c << ", " << r;
      }
    }
  }
}

TEST_P(TerrainRgb, ClampsWhatTheCodeCannotHold) {
  const std::vector<float> heights_m = {-1e9f, 1e9f, std::numeric_limits<float>::quiet_NaN(), 0.0f};
  auto encoded = encode_png_tile(heights_m, 2, 0, GetParam(), 2, 1, 1);
  ASSERT_TRUE(encoded);
  const Picture p = read_png(*encoded);
  for (int channel = 0; channel < 3; ++channel) {
    EXPECT_EQ(p.at(0, 0, channel), 0);
    EXPECT_EQ(p.at(1, 0, channel), 255);
    EXPECT_EQ(p.at(0, 1, channel), 0);
  }
  EXPECT_NEAR(coded_height_m(p, 1, 1, GetParam()), 0, 1e-9);
}

INSTANTIATE_TEST_SUITE_P(Codes, TerrainRgb, testing::Values(PngEncoding::kTerrarium, PngEncoding::kMapbox));

TEST(Hillshade, AgreesWithGdal) {
  const int posts = 65;
  const auto heights_m = sample_terrain(posts);
  auto tiff_bytes = encode_tiff_tile(heights_m, posts, {0, 30, 0, 0, 0, -20}, wkt_of(32611), {});
  ASSERT_TRUE(tiff_bytes);
  const MemoryTiff tiff(*tiff_bytes);
  ASSERT_NE(tiff.get(), nullptr);
  const char* arguments[] = {"-of", "MEM", "-az", "315", "-alt", "45", "-alg", "Horn", nullptr};
  GDALDEMProcessingOptions* options = GDALDEMProcessingOptionsNew(const_cast<char**>(arguments), nullptr);
  GDALDatasetH shaded = GDALDEMProcessing("", GDALDataset::ToHandle(tiff.get()), "hillshade", nullptr, options, nullptr);
  GDALDEMProcessingOptionsFree(options);
  ASSERT_NE(shaded, nullptr);
  std::vector<std::uint8_t> theirs(posts * posts);
  ASSERT_EQ(GDALRasterIO(GDALGetRasterBand(shaded, 1), GF_Read, 0, 0, posts, posts, theirs.data(), posts, posts, GDT_Byte, 0, 0), CE_None);
  GDALClose(shaded);

  auto encoded = encode_png_tile(heights_m, posts, 0, PngEncoding::kHillshade, posts, 30, 20);
  ASSERT_TRUE(encoded) << encoded.error().message;
  const Picture ours = read_png(*encoded);
  ASSERT_EQ(ours.channels, 1);
  int darkest = 255, brightest = 0;
  for (int r = 1; r < posts - 1; ++r) {
    for (int c = 1; c < posts - 1; ++c) {
      const double light = (theirs[r * posts + c] - 1) / 254.0;  // GDAL maps light 0..1 to 1..255
      ASSERT_NEAR(ours.at(c, r, 0), 255 * light, 1.6) << c << ", " << r;
      darkest = std::min(darkest, ours.at(c, r, 0));
      brightest = std::max(brightest, ours.at(c, r, 0));
    }
  }
  EXPECT_GT(brightest - darkest, 60);
}

TEST(Hillshade, LightComesFromTheNorthWest) {
  const int posts = 9;
  const auto shade_of = [&](double per_column_m, double per_row_m) {
    std::vector<float> plane;
    for (int r = 0; r < posts; ++r)
      for (int c = 0; c < posts; ++c) plane.push_back(static_cast<float>(c * per_column_m + r * per_row_m));
    const Picture p = read_png(*encode_png_tile(plane, posts, 0, PngEncoding::kHillshade, posts, 10, 10));
    for (const auto pixel : p.pixels) EXPECT_EQ(pixel, p.pixels[0]);  // without a halo the border continues the plane
    return static_cast<int>(p.pixels[0]);
  };
  EXPECT_EQ(shade_of(0, 0), 180);                                   // sin 45 degrees
  EXPECT_EQ(shade_of(10 / std::sqrt(2.0), 10 / std::sqrt(2.0)), 255);  // faces the light
  EXPECT_EQ(shade_of(-10, -10), 0);
  EXPECT_GT(shade_of(5, 0), 180);
  EXPECT_LT(shade_of(-5, 0), 180);
  EXPECT_GT(shade_of(0, 5), 180);
}

TEST(Hillshade, NeighboursShareTheirBorderWhenTheyHaveAHalo) {
  const int posts = 33, halo = 1, edge = 2 * posts - 1 + 2 * halo;
  const auto ground = sample_terrain(edge);
  const auto tile = [&](int first_column, int tile_halo) {
    std::vector<float> heights_m;
    for (int r = -tile_halo; r < posts + tile_halo; ++r)
      for (int c = -tile_halo; c < posts + tile_halo; ++c)
        heights_m.push_back(ground[static_cast<std::size_t>(r + halo) * edge + first_column + c + halo]);
    return heights_m;
  };
  for (const auto encoding : {PngEncoding::kHillshade, PngEncoding::kRelief}) {
    const Picture west = read_png(*encode_png_tile(tile(0, 1), posts, 1, encoding, posts, 5, 5, {400, 1100}));
    const Picture east = read_png(*encode_png_tile(tile(posts - 1, 1), posts, 1, encoding, posts, 5, 5, {400, 1100}));
    for (int r = 0; r < posts; ++r)
      for (int channel = 0; channel < west.channels; ++channel) EXPECT_EQ(west.at(posts - 1, r, channel), east.at(0, r, channel)) << r;
  }
  // Pixel centres: one picture of both tiles equals the two side by side.
  const Picture west = read_png(*encode_png_tile(tile(0, 1), posts, 1, PngEncoding::kHillshade, posts - 1, 5, 5));
  const int both = 2 * posts - 1;
  const Picture whole = read_png(*encode_png_tile(ground, both, 1, PngEncoding::kHillshade, both - 1, 5, 5));
  for (int r = 0; r < posts - 1; ++r)
    for (int c = 0; c < posts - 1; ++c) ASSERT_EQ(west.at(c, r, 0), whole.at(c, r, 0)) << c << ", " << r;
}

TEST(Relief, TintsByHeightAndDarkensByShade) {
  const int posts = 17;
  const auto colour_of = [&](float height_m) {
    const std::vector<float> flat(posts * posts, height_m);
    const Picture p = read_png(*encode_png_tile(flat, posts, 0, PngEncoding::kRelief, posts, 10, 10, {0, 1000}));
    EXPECT_EQ(p.channels, 3);
    return std::array<int, 3>{p.at(3, 3, 0), p.at(3, 3, 1), p.at(3, 3, 2)};
  };
  EXPECT_EQ(colour_of(1000), (std::array<int, 3>{180, 180, 180}));  // white times the light of flat ground
  EXPECT_EQ(colour_of(5000), colour_of(1000));
  EXPECT_EQ(colour_of(-50), colour_of(0));
  EXPECT_GT(colour_of(0)[1], colour_of(0)[0]);  // green lowland
  EXPECT_NE(colour_of(300), colour_of(600));
  const auto heights_m = sample_terrain(posts);
  const Picture shade = read_png(*encode_png_tile(heights_m, posts, 0, PngEncoding::kHillshade, posts, 20, 20));
  const Picture snow = read_png(*encode_png_tile(heights_m, posts, 0, PngEncoding::kRelief, posts, 20, 20, {-100, -50}));
  for (int r = 0; r < posts; ++r)
    for (int c = 0; c < posts; ++c) EXPECT_EQ(snow.at(c, r, 1), shade.at(c, r, 0));
}

TEST(PngTile, RefusesBadArguments) {
  const std::vector<float> nine(9);
  EXPECT_TRUE(encode_png_tile(nine, 3, 0, PngEncoding::kHillshade, 2, 1, 1));
  EXPECT_FALSE(encode_png_tile(nine, 3, 0, PngEncoding::kHillshade, 4, 1, 1));
  EXPECT_FALSE(encode_png_tile(nine, 3, 1, PngEncoding::kHillshade, 3, 1, 1));
  EXPECT_FALSE(encode_png_tile(nine, 3, 0, PngEncoding::kHillshade, 3, 0, 1));
  EXPECT_FALSE(encode_png_tile(nine, 3, 0, PngEncoding::kRelief, 3, 1, 1, {5, 4}));
  EXPECT_FALSE(encode_png_tile(nine, 1, 1, PngEncoding::kTerrarium, 0, 1, 1));
  auto bad = encode_png_tile(nine, -3, 3, PngEncoding::kTerrarium, -3, 1, 1);
  ASSERT_FALSE(bad);
  EXPECT_EQ(bad.error().code, ErrorCode::kInvalidArgument);
}

}  // namespace
}  // namespace lodestone
