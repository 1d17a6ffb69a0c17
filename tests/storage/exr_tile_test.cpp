#include "storage/formats/exr_tile.h"

#include <Imath/half.h>
#include <OpenEXR/ImfHeader.h>
#include <OpenEXR/ImfInputFile.h>
#include <OpenEXR/ImfVecAttribute.h>
#include <OpenImageIO/imageio.h>
#include <gtest/gtest.h>
#include <libdeflate.h>
#include <unistd.h>

#include <bit>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <limits>
#include <random>

#include "storage/formats/quantum.h"
#include "tests/support/sample_terrain.h"

namespace lodestone {
namespace {

constexpr ExrCompression kAll[] = {ExrCompression::kNone, ExrCompression::kZip, ExrCompression::kPiz, ExrCompression::kPxr24};

TileAttributes sample_attributes() {
  TileAttributes a;
  a.layer = "hills";
  a.recipe = "lsa";
  a.revision = "0123456789abcdef";
  a.crs = "EPSG:32611";
  a.datum = "EGM96";
  a.seed = 18446744073709551615u;
  a.z = 23;
  a.x = 5000000000;
  a.y = 17;
  a.origin_x = 400000.25;
  a.origin_y = 3800000.5;
  a.spacing_x = a.spacing_y = 0.1;
  a.height_min_m = 401.5f;
  a.height_max_m = 1099.25f;
  return a;
}

std::vector<std::uint8_t> sample_provenance(int posts) {
  std::vector<std::uint8_t> p(static_cast<std::size_t>(posts) * posts);
  for (std::size_t k = 0; k < p.size(); ++k) p[k] = static_cast<std::uint8_t>((k / 5) % 3);
  return p;
}

std::vector<std::uint8_t> bytes_of(const std::string& text) { return {text.begin(), text.end()}; }

bool same_bits(const std::vector<float>& a, const std::vector<float>& b) {
  return a.size() == b.size() && std::memcmp(a.data(), b.data(), a.size() * sizeof(float)) == 0;
}

// A file that exists while the object does.
class TemporaryFile {
 public:
  explicit TemporaryFile(const std::string& bytes) {
    std::string name = (std::filesystem::temp_directory_path() / "lodestone_XXXXXX.exr").string();
    const int fd = mkstemps(name.data(), 4);
    EXPECT_GE(fd, 0);
    close(fd);
    path_ = name;
    std::ofstream(path_, std::ios::binary) << bytes;
  }
  ~TemporaryFile() { std::filesystem::remove(path_); }
  const std::string& path() const { return path_; }

 private:
  std::string path_;
};

struct Case {
  ExrCompression compression;
  ExrPixel pixel;
  bool has_provenance;
  int posts;
};

std::vector<Case> all_cases() {
  std::vector<Case> cases;
  for (const auto compression : kAll)
    for (const auto pixel : {ExrPixel::kFloat, ExrPixel::kHalf})
      for (const bool has_provenance : {false, true})
        for (const int posts : {1, 2, 5, 33, 257}) cases.push_back({compression, pixel, has_provenance, posts});
  return cases;
}

// Heights that the combination can hold exactly.
std::vector<float> exact_heights(const Case& c) {
  auto heights_m = sample_terrain(c.posts);
  if (c.pixel == ExrPixel::kHalf) {
    for (float& h : heights_m) h = imath_half_to_float(imath_float_to_half(h));
  } else if (c.compression == ExrCompression::kPxr24) {
    EXPECT_TRUE(quantise(heights_m, 0x1p-4f));
  }
  return heights_m;
}

class ExrTile : public testing::TestWithParam<Case> {};

TEST_P(ExrTile, ComesBackBitForBitAndIsTheSameFileEveryTime) {
  const Case c = GetParam();
  const auto heights_m = exact_heights(c);
  const auto provenance = c.has_provenance ? sample_provenance(c.posts) : std::vector<std::uint8_t>{};
  const auto first = encode_exr_tile(heights_m, provenance, c.posts, sample_attributes(), {c.compression, c.pixel});
  const auto second = encode_exr_tile(heights_m, provenance, c.posts, sample_attributes(), {c.compression, c.pixel});
  ASSERT_TRUE(first && second);
  EXPECT_EQ(*first, *second);
  auto decoded = decode_exr_tile(bytes_of(*first));
  ASSERT_TRUE(decoded) << decoded.error().message;
  EXPECT_EQ(decoded->width, c.posts);
  EXPECT_EQ(decoded->height, c.posts);
  EXPECT_TRUE(same_bits(decoded->heights_m, heights_m));
  EXPECT_EQ(decoded->provenance, provenance);
}

TEST_P(ExrTile, ReadsTheSameThroughOpenImageIo) {
  const Case c = GetParam();
  const auto heights_m = exact_heights(c);
  const auto provenance = c.has_provenance ? sample_provenance(c.posts) : std::vector<std::uint8_t>{};
  auto encoded = encode_exr_tile(heights_m, provenance, c.posts, sample_attributes(), {c.compression, c.pixel});
  ASSERT_TRUE(encoded) << encoded.error().message;
  const TemporaryFile file(*encoded);
  const auto input = OIIO::ImageInput::open(file.path());
  ASSERT_NE(input, nullptr) << OIIO::geterror();
  const OIIO::ImageSpec& spec = input->spec();
  ASSERT_EQ(spec.width, c.posts);
  ASSERT_EQ(spec.height, c.posts);
  ASSERT_EQ(spec.nchannels, c.has_provenance ? 2 : 1);
  const int y_channel = spec.channelindex("Y");
  ASSERT_GE(y_channel, 0);
  EXPECT_EQ(spec.channelformat(y_channel), c.pixel == ExrPixel::kHalf ? OIIO::TypeHalf : OIIO::TypeFloat);
  EXPECT_EQ(spec.get_string_attribute("layer"), "hills");
  EXPECT_EQ(spec.get_string_attribute("tile"), "23/5000000000/17");
  EXPECT_EQ(spec.get_string_attribute("seed"), "18446744073709551615");
  EXPECT_EQ(spec.find_attribute("DateTime"), nullptr);

  std::vector<float> pixels(static_cast<std::size_t>(c.posts) * c.posts * spec.nchannels);
  ASSERT_TRUE(input->read_image(0, 0, 0, spec.nchannels, OIIO::TypeFloat, pixels.data())) << input->geterror();
  for (std::size_t k = 0; k < heights_m.size(); ++k) {
    ASSERT_EQ(pixels[k * spec.nchannels + y_channel], heights_m[k]) << "post " << k;
    if (c.has_provenance) {
      ASSERT_EQ(pixels[k * 2 + spec.channelindex("provenance")], provenance[k]) << "post " << k;
    }
  }
}

std::string case_name(const testing::TestParamInfo<Case>& info) {
  const char* names[] = {"none", "zip", "piz", "pxr24"};
  return std::string(names[static_cast<int>(info.param.compression)]) + (info.param.pixel == ExrPixel::kHalf ? "_half" : "_float") +
         (info.param.has_provenance ? "_provenance_" : "_") + std::to_string(info.param.posts);
}
INSTANTIATE_TEST_SUITE_P(Forms, ExrTile, testing::ValuesIn(all_cases()), case_name);

TEST(ExrTileHeader, NamesEveryAttributeForTheCommandLineTool) {
  auto encoded = encode_exr_tile(sample_terrain(17), sample_provenance(17), 17, sample_attributes(), {ExrCompression::kZip});
  ASSERT_TRUE(encoded) << encoded.error().message;
  const TemporaryFile file(*encoded);
  std::string text;
  FILE* pipe = popen(("exrheader " + file.path() + " 2>&1").c_str(), "r");
  ASSERT_NE(pipe, nullptr);
  for (char line[512]; std::fgets(line, sizeof line, pipe) != nullptr;) text += line;
  EXPECT_EQ(pclose(pipe), 0) << text;
  for (const char* expected :
       {"layer (type string): \"hills\"", "recipe (type string): \"lsa\"", "revision (type string): \"0123456789abcdef\"",
        "seed (type string): \"18446744073709551615\"", "tile (type string): \"23/5000000000/17\"",
        "crs (type string): \"EPSG:32611\"", "unit (type string): \"metre\"", "datum (type string): \"EGM96\"",
        "origin (type v2d)", "spacing (type v2d)", "height_range (type v2f): (401.5 1099.25)",
        "Y, 32-bit floating-point", "provenance, 16-bit floating-point", "zip, multi-scanline blocks", "(0 0) - (16 16)"}) {
    EXPECT_NE(text.find(expected), std::string::npos) << expected << "\nin\n" << text;
  }
  const Imf::InputFile input(file.path().c_str());
  EXPECT_EQ(input.header().typedAttribute<Imf::V2dAttribute>("origin").value(), Imath::V2d(400000.25, 3800000.5));
  EXPECT_EQ(input.header().typedAttribute<Imf::V2dAttribute>("spacing").value(), Imath::V2d(0.1, 0.1));
}

TEST(ExrTileBits, SurviveForEveryFloatWhereNothingIsRounded) {
  std::vector<float> odd = {0.0f, -0.0f, 1e-45f, -431.25f, 8848.86f, 3.4e38f, std::numeric_limits<float>::infinity(),
                            std::bit_cast<float>(0x7FC12345u), -1e-30f};
  for (const auto compression : {ExrCompression::kNone, ExrCompression::kZip, ExrCompression::kPiz}) {
    auto encoded = encode_exr_tile(odd, {}, 3, {}, {compression});
    ASSERT_TRUE(encoded) << encoded.error().message;
    auto decoded = decode_exr_tile(bytes_of(*encoded));
    ASSERT_TRUE(decoded) << decoded.error().message;
    EXPECT_TRUE(same_bits(decoded->heights_m, odd));
  }
}

TEST(ExrTileHalf, RoundsToTheNearestAndTiesToEven) {
  std::vector<float> heights_m, expected;
  for (int bits = 0; bits < 0x7BFF; ++bits) {  // every pair of finite neighbours
    const float low = imath_half_to_float(static_cast<std::uint16_t>(bits));
    const float high = imath_half_to_float(static_cast<std::uint16_t>(bits + 1));
    const float middle = 0.5f * (low + high);
    heights_m.insert(heights_m.end(), {std::nextafter(middle, low), middle, -std::nextafter(middle, high)});
    expected.insert(expected.end(), {low, bits % 2 == 0 ? low : high, -high});
  }
  const int posts = static_cast<int>(std::ceil(std::sqrt(heights_m.size())));
  heights_m.resize(static_cast<std::size_t>(posts) * posts);
  expected.resize(heights_m.size());
  auto encoded = encode_exr_tile(heights_m, {}, posts, {}, {ExrCompression::kZip, ExrPixel::kHalf});
  ASSERT_TRUE(encoded) << encoded.error().message;
  auto decoded = decode_exr_tile(bytes_of(*encoded));
  ASSERT_TRUE(decoded) << decoded.error().message;
  EXPECT_TRUE(same_bits(decoded->heights_m, expected));
}

TEST(ExrTileHalf, RefusesWhatWouldBecomeInfinite) {
  for (const float bad : {65520.0f, -70000.0f, std::numeric_limits<float>::quiet_NaN()}) {
    auto encoded = encode_exr_tile(std::vector<float>{bad}, {}, 1, {}, {ExrCompression::kNone, ExrPixel::kHalf});
    ASSERT_FALSE(encoded);
    EXPECT_EQ(encoded.error().code, ErrorCode::kInvalidArgument);
  }
  EXPECT_TRUE(encode_exr_tile(std::vector<float>{65519.0f}, {}, 1, {}, {ExrCompression::kNone, ExrPixel::kHalf}));
}

TEST(ExrTileArguments, MustHaveMatchingSizes) {
  const std::vector<float> four(4);
  const std::vector<std::uint8_t> three(3), bad = {0, 1, 2, 3};
  for (const int posts : {-1, 0, 1, 3, 100000}) EXPECT_FALSE(encode_exr_tile(four, {}, posts, {}, {})) << posts;
  EXPECT_FALSE(encode_exr_tile(four, three, 2, {}, {}));
  EXPECT_FALSE(encode_exr_tile(four, bad, 2, {}, {}));
}

class HostileExr : public testing::TestWithParam<ExrCompression> {
 protected:
  static std::vector<std::uint8_t> small_file() {
    auto heights_m = sample_terrain(37);
    EXPECT_TRUE(quantise(heights_m, 0.25f));
    auto encoded = encode_exr_tile(heights_m, sample_provenance(37), 37, sample_attributes(), {GetParam(), ExrPixel::kFloat});
    EXPECT_TRUE(encoded);
    return bytes_of(*encoded);
  }
};

TEST_P(HostileExr, EveryTruncatedPrefixIsRefused) {
  const auto whole = small_file();
  for (std::size_t size = 0; size < whole.size(); ++size) {
    const std::vector<std::uint8_t> prefix(whole.begin(), whole.begin() + static_cast<std::ptrdiff_t>(size));
    EXPECT_FALSE(decode_exr_tile(prefix)) << size << " of " << whole.size() << " bytes";
  }
}

TEST_P(HostileExr, FlippedBitsNeverCrash) {
  const auto whole = small_file();
  std::mt19937 random(20240229);
  int refused = 0;
  for (int k = 0; k < 1000; ++k) {
    auto bytes = whole;
    // Half of them in the header and the index, where sizes and offsets are.
    const std::size_t reach = k % 2 == 0 ? std::min<std::size_t>(800, bytes.size()) : bytes.size();
    bytes[random() % reach] ^= static_cast<std::uint8_t>(1u << (random() % 8));
    const auto decoded = decode_exr_tile(bytes, 1 << 16);
    if (!decoded) {
      ++refused;
    } else {
      EXPECT_LE(static_cast<std::int64_t>(decoded->width) * decoded->height, 1 << 16);
      EXPECT_EQ(decoded->heights_m.size(), static_cast<std::size_t>(decoded->width) * decoded->height);
    }
  }
  EXPECT_GT(refused, 50);
}

TEST_P(HostileExr, DeclaredSizesAreCheckedFirst) {
  const auto whole = small_file();
  const std::string key("dataWindow\0box2i\0", 17);
  const auto at = std::search(whole.begin(), whole.end(), key.begin(), key.end());
  ASSERT_NE(at, whole.end());
  const auto window = static_cast<std::size_t>(at - whole.begin()) + key.size() + 4;
  const auto with_window = [&](std::int32_t x0, std::int32_t y0, std::int32_t x1, std::int32_t y1) {
    auto bytes = whole;
    const std::int32_t box[4] = {x0, y0, x1, y1};
    std::memcpy(bytes.data() + window, box, sizeof box);
    return decode_exr_tile(bytes);
  };
  for (const std::int32_t edge : {4097, 16384, 400000}) {
    auto bomb = with_window(0, 0, edge - 1, edge - 1);
    ASSERT_FALSE(bomb);
    EXPECT_EQ(bomb.error().code, ErrorCode::kTooLarge) << edge << ": " << bomb.error().message;
  }
  EXPECT_FALSE(with_window(0, 0, 2147483647, 2147483647));
  EXPECT_FALSE(with_window(-2147483647, -2147483647, 2147483647, 2147483647));
  EXPECT_FALSE(with_window(0, 0, -1, -1));
  auto hollow = with_window(0, 0, 1, 2097151);
  EXPECT_FALSE(hollow);
  auto within_limit = with_window(0, 0, 4095, 4095);  // allowed size, but the file holds no such thing
  ASSERT_FALSE(within_limit);
  EXPECT_EQ(within_limit.error().code, ErrorCode::kCorrupt) << within_limit.error().message;
}

// Memory that no byte of the file filled must not be served as heights.
TEST_P(HostileExr, AChunkThatHoldsTooFewBytesIsRefused) {
  const int posts = 9;  // zip, piz, pxr24: a single chunk, at the end of the file
  auto encoded = encode_exr_tile(std::vector<float>(81, 100.0f), {}, posts, {}, {GetParam()});
  ASSERT_TRUE(encoded);
  auto bytes = bytes_of(*encoded);
  const std::size_t row_bytes = 8 + posts * sizeof(float);
  if (GetParam() == ExrCompression::kNone) {
    const std::size_t size_at = bytes.size() - row_bytes + 4;
    bytes[size_at] = 4;
  } else {
    std::uint32_t size = 0;
    std::size_t chunk = 0;  // found by its own size: a chunk's head is its line (0) and the bytes that follow to the end
    for (std::size_t at = 0; at + 8 < bytes.size(); ++at) {
      std::memcpy(&size, &bytes[at + 4], 4);
      if (size == bytes.size() - at - 8 && std::memcmp(&bytes[at], "\0\0\0\0", 4) == 0) chunk = at;
    }
    ASSERT_GT(chunk, 300u);
    const std::vector<std::uint8_t> inside(40, 7);
    std::vector<std::uint8_t> deflated(100);
    libdeflate_compressor* deflater = libdeflate_alloc_compressor(6);
    size = static_cast<std::uint32_t>(libdeflate_zlib_compress(deflater, inside.data(), inside.size(), deflated.data(), deflated.size()));
    libdeflate_free_compressor(deflater);
    ASSERT_GT(size, 0u);
    bytes.resize(chunk + 8);
    std::memcpy(&bytes[chunk + 4], &size, 4);
    bytes.insert(bytes.end(), deflated.begin(), deflated.begin() + size);
  }
  auto decoded = decode_exr_tile(bytes);
  EXPECT_FALSE(decoded);
}

INSTANTIATE_TEST_SUITE_P(Compressions, HostileExr, testing::ValuesIn(kAll));

TEST(DecodeExr, RefusesOtherThings) {
  EXPECT_FALSE(decode_exr_tile({}));
  EXPECT_FALSE(decode_exr_tile(bytes_of("II*\0 not an EXR at all, but long enough to look at")));
}

TEST(DecodeExr, RefusesAFileWithoutHeights) {
  const TemporaryFile file("");
  auto output = OIIO::ImageOutput::create("exr");
  OIIO::ImageSpec spec(4, 4, 1, OIIO::TypeFloat);
  spec.channelnames = {"Z"};
  const std::vector<float> pixels(16, 1.0f);
  ASSERT_TRUE(output->open(file.path(), spec) && output->write_image(OIIO::TypeFloat, pixels.data()) && output->close());
  std::ifstream in(file.path(), std::ios::binary);
  const std::vector<std::uint8_t> bytes{std::istreambuf_iterator<char>(in), {}};
  auto decoded = decode_exr_tile(bytes);
  ASSERT_FALSE(decoded);
  EXPECT_EQ(decoded.error().code, ErrorCode::kUnsupported);
}

TEST(DecodeExr, ReadsWhatAnotherWriterMade) {
  const auto heights_m = sample_terrain(40);
  for (const char* compression : {"none", "rle", "zips", "zip", "piz"}) {
    const TemporaryFile file("");
    auto output = OIIO::ImageOutput::create("exr");
    OIIO::ImageSpec spec(40, 40, 1, OIIO::TypeFloat);
    spec.channelnames = {"Y"};
    spec.attribute("compression", compression);
    ASSERT_TRUE(output->open(file.path(), spec) && output->write_image(OIIO::TypeFloat, heights_m.data()) && output->close());
    std::ifstream in(file.path(), std::ios::binary);
    const std::vector<std::uint8_t> bytes{std::istreambuf_iterator<char>(in), {}};
    auto decoded = decode_exr_tile(bytes);
    ASSERT_TRUE(decoded) << compression << ": " << decoded.error().message;
    EXPECT_TRUE(same_bits(decoded->heights_m, heights_m)) << compression;
  }
}

}  // namespace
}  // namespace lodestone
