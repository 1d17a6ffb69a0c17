// Masks: decoded, warped to the layer's cells, kept, combined.

#include "storage/dem/mask_store.h"

#include <OpenImageIO/filesystem.h>
#include <OpenImageIO/imageio.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

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

std::vector<std::uint8_t> file_bytes(const std::string& path) {
  std::ifstream in(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(in), {}};
}

// Image bytes of one kind by OpenImageIO; value(x, y, channel) 0..1.
std::vector<std::uint8_t> image(const std::string& name, int width, int height, int channels,
                                OIIO::TypeDesc type, const std::function<float(int, int, int)>& value) {
  OIIO::ImageSpec spec(width, height, channels, type);
  spec.attribute("oiio:UnassociatedAlpha", 1);  // write the channels as they are
  const auto out = OIIO::ImageOutput::create(name);
  std::vector<float> pixels;
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < width; ++x) {
      for (int c = 0; c < channels; ++c) pixels.push_back(value(x, y, c));
    }
  }
  EXPECT_TRUE(out->open(name, spec)) << out->geterror();
  EXPECT_TRUE(out->write_image(OIIO::TypeDesc::FLOAT, pixels.data()));
  out->close();
  return file_bytes(name);
}

// A layer of 41 x 31 posts, 30 m apart: 40 x 30 cells. Post (0, 0) at (500015, 3999985).
class Masks : public ::testing::Test {
 protected:
  void SetUp() override {
    write_raster(scratch_ / "dem.tif", {41, 31}, [](int i, int j, int) { return hills(i, j); });
    auto store = ingest_and_open(data_dir(), options_for("a", {scratch_ / "dem.tif"}));
    ASSERT_TRUE(store) << store.error().message;
    info_ = (*store)->info();
    reopen();
  }
  void reopen() {
    masks_.reset();
    auto masks = MaskStore::open(data_dir(), info_);
    ASSERT_TRUE(masks) << masks.error().message;
    masks_ = *masks;
  }
  std::filesystem::path data_dir() const { return scratch_.path() / "data"; }
  MaskCrop crop(const std::string& name, int level, const PostWindow& window) {
    const std::string names[] = {name};
    auto c = masks_->crop(names, level, window);
    EXPECT_TRUE(c) << (c ? "" : c.error().message);
    return c ? *c : MaskCrop{};
  }
  Scratch scratch_;
  LayerInfo info_;
  std::shared_ptr<MaskStore> masks_;
};

TEST_F(Masks, KeepsAPngOfOnePixelPerCellExactly) {
  const auto grey = [](int x, int y) { return static_cast<std::uint8_t>((x * 5 + y * 7) % 256); };
  const auto bytes = image(scratch_ / "m.png", 40, 30, 1, OIIO::TypeDesc::UINT8,
                           [&](int x, int y, int) { return static_cast<float>(grey(x, y)) / 255.0F; });
  auto put = masks_->put("roads", bytes);
  ASSERT_TRUE(put) << put.error().message;
  EXPECT_EQ(put->level, 0);
  EXPECT_EQ(put->width, 40);
  EXPECT_EQ(put->height, 30);
  reopen();  // acknowledged = kept
  ASSERT_EQ(masks_->list().size(), 1U);
  const MaskCrop c = crop("roads", 0, {-3, -2, 42, 31});
  for (int y = -2; y <= 31; ++y) {
    for (int x = -3; x <= 42; ++x) {
      const int mx = x < 0 ? -1 - x : (x > 39 ? 79 - x : x), my = y < 0 ? -1 - y : (y > 29 ? 59 - y : y);
      ASSERT_EQ(c.pixels[static_cast<std::size_t>((y + 2) * 46 + x + 3)], grey(mx, my)) << x << "," << y;
    }
  }
  // Finer: replicated. Coarser: the mean, rounded.
  EXPECT_EQ(crop("roads", 2, {9, 6, 9, 6}).pixels[0], grey(2, 1));
  EXPECT_EQ(crop("roads", -1, {3, 2, 3, 2}).pixels[0],
            (grey(6, 4) + grey(7, 4) + grey(6, 5) + grey(7, 5) + 2) / 4);
}

TEST_F(Masks, KeepsAMaskOnTheDemsOwnPixelsExactly) {
  RasterSpec spec{41, 31};
  spec.type = GDT_Byte;
  write_raster(scratch_ / "m.tif", spec,
               [](int i, int j, int) { return (i * 3 + j) % 7 == 0 ? 1 : 0; });  // 0/1: 1 is white
  auto put = masks_->put("rivers", file_bytes(scratch_ / "m.tif"));
  ASSERT_TRUE(put) << put.error().message;
  EXPECT_EQ(put->level, 1);
  EXPECT_EQ(put->width, 80);
  const MaskCrop c = crop("rivers", 1, {0, 0, 79, 59});
  for (int y = 0; y < 60; ++y) {
    for (int x = 0; x < 80; ++x) {
      const int i = (x + 1) / 2, j = (y + 1) / 2;
      ASSERT_EQ(c.pixels[static_cast<std::size_t>(y * 80 + x)], (i * 3 + j) % 7 == 0 ? 255 : 0)
          << x << "," << y;
    }
  }
}

TEST_F(Masks, WarpsFromAnotherReferenceSystemAndLeavesTheRestBlack) {
  // White box of degrees around the layer's north-west quarter.
  RasterSpec spec{200, 200};
  spec.crs = "EPSG:4326";
  spec.type = GDT_Byte;
  const auto p = info_.bounds_wgs84;
  const double w = (p[2] - p[0]) / 2, h = (p[3] - p[1]) / 2;
  spec.transform = {p[0], w / 200, 0, p[3], 0, -h / 200};
  write_raster(scratch_ / "m.tif", spec, [](int, int, int) { return 255; });
  auto put = masks_->put("box", file_bytes(scratch_ / "m.tif"));
  ASSERT_TRUE(put) << put.error().message;
  EXPECT_NEAR(put->mean, 0.25, 0.02);
  const int level = put->level;
  const auto at = [&](double x, double y) {
    const auto px = static_cast<std::int64_t>(std::ldexp(x, level)),
               py = static_cast<std::int64_t>(std::ldexp(y, level));
    return crop("box", level, {px, py, px, py}).pixels[0];
  };
  EXPECT_EQ(at(5, 5), 255);
  EXPECT_EQ(at(35, 5), 0);
  EXPECT_EQ(at(5, 25), 0);
}

TEST_F(Masks, ReadsExrColourAlphaAndFloatsOutOfRange) {
  auto put = masks_->put("e", image(scratch_ / "m.exr", 40, 30, 1, OIIO::TypeDesc::FLOAT,
                                    [](int x, int, int) { return x < 20 ? 7.5F : -3.0F; }));
  ASSERT_TRUE(put) << put.error().message;
  EXPECT_EQ(crop("e", 0, {3, 3, 3, 3}).pixels[0], 255);
  EXPECT_EQ(crop("e", 0, {23, 3, 23, 3}).pixels[0], 0);
  // RGBA: the mean of red, green and blue, whatever alpha says.
  put = masks_->put("c", image(scratch_ / "c.png", 40, 30, 4, OIIO::TypeDesc::UINT8,
                               [](int, int, int c) { return c == 3 ? 0.2F : (c == 0 ? 0.6F : 0.0F); }));
  ASSERT_TRUE(put) << put.error().message;
  EXPECT_NEAR(crop("c", 0, {3, 3, 3, 3}).pixels[0], 51, 1);
}

TEST_F(Masks, UnitesSeveralByTheirMaximumAndForgetsTheRemoved) {
  const auto half = [&](int from) {
    return image(scratch_ / "h.png", 40, 30, 1, OIIO::TypeDesc::UINT8,
                 [from](int x, int, int) { return x >= from && x < from + 10 ? 1.0F : 0.25F; });
  };
  ASSERT_TRUE(masks_->put("one", half(0)));
  const std::uint64_t first = masks_->digest();
  ASSERT_TRUE(masks_->put("two", half(20)));
  EXPECT_NE(masks_->digest(), first);
  const std::string both[] = {"one", "two"};
  auto c = masks_->crop(both, 0, {0, 0, 39, 0});
  ASSERT_TRUE(c);
  EXPECT_EQ(c->pixels[5], 255);
  EXPECT_EQ(c->pixels[15], 64);
  EXPECT_EQ(c->pixels[25], 255);
  EXPECT_EQ(*masks_->finest_level(both), 0);
  ASSERT_TRUE(masks_->remove("two"));
  EXPECT_EQ(masks_->digest(), first);
  EXPECT_EQ(masks_->remove("two").error().code, ErrorCode::kNotFound);
  EXPECT_EQ(masks_->crop(both, 0, {0, 0, 0, 0}).error().code, ErrorCode::kNotFound);
  EXPECT_EQ(masks_->get("two", "png").error().code, ErrorCode::kNotFound);
  // Given back, it is the same mask.
  for (const char* extension : {"tif", "png"}) {
    auto back = masks_->get("one", extension);
    ASSERT_TRUE(back) << back.error().message;
    ASSERT_TRUE(masks_->put("again", {reinterpret_cast<const std::uint8_t*>(back->data()), back->size()}));
    EXPECT_EQ(crop("again", 0, {0, 0, 39, 29}).pixels, crop("one", 0, {0, 0, 39, 29}).pixels) << extension;
  }
  EXPECT_EQ(masks_->get("one", "exr").error().code, ErrorCode::kUnsupported);
}

TEST_F(Masks, FollowTheLayerToANewGrid) {
  RasterSpec spec{41, 31};
  spec.type = GDT_Byte;
  write_raster(scratch_ / "m.tif", spec, [](int i, int, int) { return i < 20 ? 255 : 0; });
  ASSERT_TRUE(masks_->put("west", file_bytes(scratch_ / "m.tif")));
  // The same ground, ten columns more to the west.
  RasterSpec wider{51, 31};
  wider.transform[0] -= 300;
  write_raster(scratch_ / "wide.tif", wider, [](int i, int j, int) { return hills(i, j); });
  auto info = ingest(data_dir(), options_for("a", {scratch_ / "wide.tif"}), real_kernels(), nullptr);
  ASSERT_TRUE(info) << info.error().message;
  // The old store still serves the old grid.
  EXPECT_EQ(crop("west", 1, {2, 2, 2, 2}).pixels[0], 255);
  info_ = *info;
  reopen();
  EXPECT_EQ(crop("west", 1, {2, 2, 2, 2}).pixels[0], 0);
  EXPECT_EQ(crop("west", 1, {22, 2, 22, 2}).pixels[0], 255);
  auto report = verify_layer(data_dir(), "a", nullptr);
  ASSERT_TRUE(report);
  EXPECT_THAT(report->problems, ::testing::IsEmpty());
}

TEST_F(Masks, RefusesHostileBytes) {
  const auto code_of = [&](const std::vector<std::uint8_t>& bytes) {
    auto put = masks_->put("x", bytes);
    EXPECT_FALSE(put);
    return put ? ErrorCode::kInternal : put.error().code;
  };
  EXPECT_EQ(code_of({}), ErrorCode::kUnsupported);
  EXPECT_EQ(code_of({'<', 'V', 'R', 'T', 'D', 'a', 't', 'a', 's', 'e', 't', '>'}), ErrorCode::kUnsupported);
  EXPECT_EQ(masks_->put("../x", {}).error().code, ErrorCode::kInvalidArgument);

  // A 16384 x 16384 EXR of a few hundred kilobytes, and PNG and TIFF headers that declare as much.
  OIIO::ImageSpec spec(16384, 16384, 1, OIIO::TypeDesc::HALF);
  spec.attribute("compression", "zip");
  const auto out = OIIO::ImageOutput::create("big.exr");
  ASSERT_TRUE(out->open(scratch_ / "big.exr", spec));
  const std::vector<float> row(16384, 0.5F);
  for (int y = 0; y < 16384; ++y) ASSERT_TRUE(out->write_scanline(y, 0, OIIO::TypeDesc::FLOAT, row.data()));
  out->close();
  EXPECT_EQ(code_of(file_bytes(scratch_ / "big.exr")), ErrorCode::kTooLarge);
  auto png = image(scratch_ / "p.png", 8, 8, 1, OIIO::TypeDesc::UINT8, [](int, int, int) { return 0.5F; });
  auto big_png = png;
  big_png[17] = 1;  // 65544 columns
  EXPECT_EQ(code_of(big_png), ErrorCode::kTooLarge);
  RasterSpec sparse{40000, 40000};
  sparse.type = GDT_Byte;
  sparse.options = {"SPARSE_OK=TRUE", "TILED=YES"};
  write_raster(scratch_ / "s.tif", sparse, nullptr);
  EXPECT_EQ(code_of(file_bytes(scratch_ / "s.tif")), ErrorCode::kTooLarge);
  RasterSpec palette{10, 10};
  palette.type = GDT_Byte;
  palette.is_palette = true;
  write_raster(scratch_ / "pal.tif", palette, [](int, int, int) { return 1; });
  EXPECT_EQ(code_of(file_bytes(scratch_ / "pal.tif")), ErrorCode::kUnsupported);

  // Cut short or with flipped bits: an error or a mask, never a crash.
  RasterSpec tif{30, 30};
  tif.type = GDT_Byte;
  tif.options = {"COMPRESS=LZW"};
  write_raster(scratch_ / "t.tif", tif, [](int i, int j, int) { return (i * j) % 256; });
  const auto exr = image(scratch_ / "t.exr", 30, 30, 1, OIIO::TypeDesc::HALF,
                         [](int x, int y, int) { return static_cast<float>(x * y % 9) / 9; });
  std::uint32_t random = 99;
  int failed = 0;
  for (const auto& good : {png, exr, file_bytes(scratch_ / "t.tif")}) {
    for (int n = 0; n < 60; ++n) {
      auto bad = good;
      if (n < 20) bad.resize(good.size() * static_cast<std::size_t>(n) / 20);
      for (int flips = n < 20 ? 0 : 3; flips > 0; --flips) {
        random = random * 1664525U + 1013904223U;
        bad[(random >> 8) % bad.size()] ^= static_cast<std::uint8_t>(1U << (random >> 29));
      }
      if (auto put = masks_->put("x", bad); !put) ++failed;
    }
  }
  EXPECT_GT(failed, 20);
  auto report = verify_layer(data_dir(), "a", nullptr);
  ASSERT_TRUE(report);
  EXPECT_THAT(report->problems, ::testing::IsEmpty());
}

TEST_F(Masks, IsRefusedWhileAnotherWriterHoldsTheLayer) {
  const auto bytes =
      image(scratch_ / "m.png", 40, 30, 1, OIIO::TypeDesc::UINT8, [](int, int, int) { return 1.0F; });
  auto lock = FileLock::acquire(data_dir() / "layers" / "a" / "lock", "layer a");
  ASSERT_TRUE(lock);
  EXPECT_EQ(masks_->put("m", bytes).error().code, ErrorCode::kConflict);
  EXPECT_TRUE(masks_->list().empty());
}

}  // namespace
}  // namespace lodestone
