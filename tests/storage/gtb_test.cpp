#include "storage/formats/gtb.h"

#include <gtest/gtest.h>

#include <random>

#include "kernels/texture/gtb_model.h"
#include "tests/support/gtb_samples.h"
#include "tests/support/jacksboro.h"
#include "tests/support/mesh_check.h"

namespace lodestone {
namespace {

std::vector<std::uint8_t> bytes_of(const std::string& text) { return {text.begin(), text.end()}; }

std::string hex_of(const std::string& bytes) {
  std::string hex;
  for (const char c : bytes) {
    for (const int nibble : {c >> 4 & 15, c & 15}) hex += "0123456789abcdef"[nibble];
  }
  return hex;
}

// A model from bytes, however many there are.
struct Decoded {
  GtbPrefix prefix;
  GtbModelDecoder model;
  bool is_refused;
};
std::optional<Decoded> decoded(std::span<const std::uint8_t> bytes) {
  Result<GtbPrefix> prefix = decode_gtb(bytes);
  if (!prefix) return std::nullopt;
  Result<GtbModelDecoder> model = GtbModelDecoder::open(prefix->stream.header);
  if (!model) return std::nullopt;
  bool is_refused = false;
  for (const GtbChunk& chunk : prefix->stream.chunks) {
    if (!model->accept(chunk)) {
      is_refused = true;
      break;
    }
  }
  return Decoded{std::move(*prefix), std::move(*model), is_refused};
}

struct Sample {
  Bitree tree;
  TextureModel texture;
  std::string bytes;
};
Sample sample(int side, int pixels) {
  Sample result;
  result.tree = test::terrain_tree(side, 2, 1);
  result.texture = *texture_model_of(*segment_texture(test::patchy_image(pixels, pixels - 5)), 0.9);
  const GtbMetadata metadata{2.0, 1.0, bitree_error_bounds(result.tree, 2.0), {{"layer", "hills"}}};
  result.bytes = encode_gtb(encode_gtb_model(&result.tree, &result.texture), &metadata);
  return result;
}

TEST(GtbFormat, WritesTheKnownStream) {
  std::vector<float> heights;
  for (int row = 0; row < 5; ++row) {
    for (int col = 0; col < 5; ++col) heights.push_back(static_cast<float>(10 + 2 * row + 3 * col + (row == 1 && col == 1 ? 6 : 0)));
  }
  BitreeRequest request;
  request.field = {heights, {}, 5, 5, 0};
  request.max_error_m = 0;
  const Result<Bitree> tree = build_bitree(request);
  ASSERT_TRUE(tree);
  EXPECT_EQ(tree->selected, 5U);
  EXPECT_EQ(tree->fictitious, 3U);
  EXPECT_EQ(hex_of(encode_gtb(encode_gtb_model(&*tree, nullptr))),
            "4754423101010200020000000000000000000000000000000000f03f0a00000016000000120000001e00000000000000"
            "92260ee5470002033ffff8f64dc07b4701040373fff8571f5c46470204030cfff89442659f47030403bffff878d12193"
            "4500000c050000000300000000000000b1a90a34");
}

TEST(GtbFormat, RangeCoderWritesTheKnownBits) {
  RangeEncoder coder;
  RangeCell cell;
  for (const bool bit : {true, false, true, true, false, false, false, true}) coder.bit(cell, bit);
  EXPECT_EQ(coder.finish(), (std::vector<std::uint8_t>{0x95, 0x24, 0x2c, 0xf8, 0xd4}));
  EXPECT_EQ(cell.p, 26482);
}

TEST(GtbFormat, RangeCoderReadsBackEveryNumber) {
  std::mt19937_64 random(6);
  std::vector<std::uint32_t> numbers{0, 1, 2, 3, 0xfffffffe, 0x7fffffff, 0x80000000};
  for (int i = 0; i < 3000; ++i) numbers.push_back(static_cast<std::uint32_t>(random() >> 32 >> random() % 32) & 0xfffffffe);
  std::vector<RangeCell> cells(kUintCells);
  RangeEncoder encoder;
  for (const std::uint32_t n : numbers) code_uint(encoder, cells.data(), n);
  const std::vector<std::uint8_t> bytes = encoder.finish();
  cells.assign(kUintCells, {});
  RangeDecoder decoder(bytes);
  for (const std::uint32_t n : numbers) ASSERT_EQ(code_uint(decoder, cells.data(), 0), n);
}

struct KnownTile {
  double threshold_m, max_error_m, step_m;
  std::size_t selected, fictitious, triangles;
  double rms_m, max_m;
  std::size_t bytes;
};

TEST(GtbJacksboro, HasTheKnownPointsErrorsAndBytes) {
  const test::SampleDem dem = test::jacksboro();
  ASSERT_GT(dem.cols, 0) << "python3-matplotlib's sample DEM is missing";
  const std::vector<float> heights = dem.window(0, 0, 257);
  const KnownTile tiles[] = {{0, -1, 1, 65933, 32, 130924, 0.1265, 15.5, 0},     {1, -1, 1, 64610, 452, 129169, 0.4537, 20, 0},
                             {4, -1, 1, 49755, 4330, 107418, 2.0831, 38, 0},     {8, -1, 1, 30326, 5689, 71455, 4.4354, 58.5, 26602},
                             {16, -1, 1, 13342, 2555, 31415, 8.7516, 83, 0},     {-1, 4, 4, 36418, 8400, 88944, -1, 4, 23817},
                             {-1, 16, 16, 11338, 8109, 38491, -1, 16, 8616}};
  for (const KnownTile& known : tiles) {
    BitreeRequest request;
    request.field = {heights, {}, 257, 257, 0};
    request.is_edge_shared = false;
    request.z_step_m = known.step_m;
    if (known.threshold_m >= 0) request.threshold_m = known.threshold_m;
    if (known.max_error_m >= 0) request.max_error_m = known.max_error_m;
    const Result<Bitree> tree = build_bitree(request);
    ASSERT_TRUE(tree);
    EXPECT_EQ(tree->selected, known.selected);
    EXPECT_EQ(tree->fictitious, known.fictitious);
    EXPECT_EQ(bitree_mesh(*tree).triangle_count(), known.triangles);
    const BitreeError error = measure_bitree_error(*tree, request.field);
    EXPECT_EQ(error.max_m, known.max_m);
    if (known.rms_m >= 0) {
      EXPECT_NEAR(error.rms_m, known.rms_m, 5e-5);
    }
    const std::string bytes = encode_gtb(encode_gtb_model(&*tree, nullptr));
    if (known.bytes != 0) {
      EXPECT_EQ(bytes.size(), known.bytes);
    }
    const std::optional<Decoded> back = decoded(bytes_of(bytes));
    ASSERT_TRUE(back && back->model.is_complete());
    const Bitree copy = back->model.tree();
    EXPECT_EQ(copy.q, tree->q);
    EXPECT_EQ(copy.state, tree->state);
    if (known.threshold_m == 0) {   // lossless where kept
      for (std::size_t at = 0; at < heights.size(); ++at) {
        if (tree->state[at] == BitreeState::kSelected) {
          ASSERT_EQ(copy.q[at], heights[at]);
        }
      }
    }
  }
}

TEST(GtbFormat, EveryPrefixIsAConformingModelWithinItsStatedError) {
  const Sample s = sample(17, 24);
  const std::vector<std::uint8_t> all = bytes_of(s.bytes);
  const std::vector<float> heights = test::heights_of(test::Kind::kInteger, 3, 8, 17, 17, 0, 4);
  const PostField field{heights, {}, 17, 17, 0};
  std::size_t good_before = 0;
  for (std::size_t size = 0; size <= all.size(); ++size) {
    const std::vector<std::uint8_t> bytes(all.begin(), all.begin() + static_cast<std::ptrdiff_t>(size));   // just that size, for the sanitizer
    const std::optional<Decoded> part = decoded(bytes);
    ASSERT_EQ(part.has_value(), size >= kGtbHeaderBytes) << size;
    if (!part) continue;
    EXPECT_FALSE(part->is_refused);
    EXPECT_EQ(part->prefix.stopped, "");
    EXPECT_EQ(part->prefix.is_complete, size == all.size());
    EXPECT_EQ(part->model.is_complete(), size == all.size());
    if (part->prefix.good_bytes == good_before) continue;   // nothing new
    good_before = part->prefix.good_bytes;
    const Bitree tree = part->model.tree();
    ASSERT_EQ(test::mesh_fault(bitree_mesh(tree)), "");
    if (part->prefix.metadata) {
      EXPECT_EQ(part->prefix.metadata->texts.at("layer"), "hills");
      const double bound = part->prefix.metadata->error_bounds_m.at(static_cast<std::size_t>(part->model.geometry_level()));
      EXPECT_LE(measure_bitree_error(tree, field).max_m, bound);
    }
  }
}

TEST(GtbFormat, ArrivingInPiecesChangesNothing) {
  const Sample s = sample(65, 80);
  const std::vector<std::uint8_t> all = bytes_of(s.bytes);
  const Result<GtbPrefix> whole = decode_gtb(all);
  std::mt19937 random(8);
  for (const unsigned most : {1U, 7U, 300U}) {
    GtbReader reader;
    std::vector<GtbChunk> chunks;
    for (std::size_t at = 0; at < all.size();) {
      const std::size_t size = std::min<std::size_t>(1 + random() % most, all.size() - at);
      ASSERT_TRUE(reader.push(std::span(all).subspan(at, size)));
      for (GtbChunk& chunk : reader.take()) chunks.push_back(std::move(chunk));
      at += size;
    }
    EXPECT_EQ(chunks, whole->stream.chunks);
    EXPECT_TRUE(reader.is_complete());
    EXPECT_EQ(reader.good_bytes(), all.size());
    EXPECT_FALSE(reader.push(std::span(all).first(1)));
  }
}

TEST(GtbFormat, EveryChangedByteIsNoticed) {
  const Sample s = sample(9, 16);
  std::vector<std::uint8_t> bytes = bytes_of(s.bytes);
  for (std::size_t at = 0; at < bytes.size(); ++at) {
    for (const int flip : {0x01, 0x80, 0xff}) {
      bytes[at] = static_cast<std::uint8_t>(bytes[at] ^ flip);
      const std::optional<Decoded> part = decoded(bytes);
      EXPECT_TRUE(!part || !part->model.is_complete()) << at;
      bytes[at] = static_cast<std::uint8_t>(bytes[at] ^ flip);
    }
  }
  bytes.push_back(0);
  EXPECT_NE(decode_gtb(bytes)->stopped, "");
}

TEST(GtbFormat, HeadersOutOfRangeAreRefusedBeforeAnythingIsAllocated) {
  const auto refused = [](auto change) {
    GtbHeader header;
    header.has_geometry = header.has_texture = true;
    header.n_geo = 4;
    header.n_tex = 4;
    header.texture_width = header.texture_height = 16;
    change(header);
    const std::string bytes = gtb_header_bytes(header);
    Result<GtbPrefix> prefix = decode_gtb(bytes_of(bytes));
    return prefix ? std::string() : prefix.error().message;
  };
  EXPECT_EQ(refused([](GtbHeader&) {}), "");
  EXPECT_NE(refused([](GtbHeader& h) { h.n_geo = 0; }), "");
  EXPECT_NE(refused([](GtbHeader& h) { h.n_geo = 14; }), "");
  EXPECT_NE(refused([](GtbHeader& h) { h.n_tex = 200; }), "");
  EXPECT_NE(refused([](GtbHeader& h) { h.has_geometry = h.has_texture = false; }), "");
  EXPECT_NE(refused([](GtbHeader& h) { h.has_texture = false; }), "");
  EXPECT_NE(refused([](GtbHeader& h) { h.texture_width = 17; }), "");
  EXPECT_NE(refused([](GtbHeader& h) { h.texture_height = 0; }), "");
  EXPECT_NE(refused([](GtbHeader& h) { h.z_step_m = 0; }), "");
  EXPECT_NE(refused([](GtbHeader& h) { h.z_offset_m = NAN; }), "");
  EXPECT_NE(refused([](GtbHeader& h) { h.corner_q[2] = 1 << 26; }), "");
  EXPECT_NE(refused([](GtbHeader& h) { h.predictor = 1; }), "");
  GtbLimits limits;
  limits.max_n_geo = 3;
  GtbHeader header;
  header.has_geometry = true;
  header.n_geo = 4;
  EXPECT_EQ(decode_gtb(bytes_of(gtb_header_bytes(header)), limits).error().code, ErrorCode::kTooLarge);
}

TEST(GtbFormat, HostileChunksEndTheStream) {
  GtbHeader header;
  header.has_geometry = true;
  header.n_geo = 2;
  const std::string head = gtb_header_bytes(header);
  const auto stops = [&](const std::string& chunk) {
    const Result<GtbPrefix> prefix = decode_gtb(bytes_of(head + chunk));
    return prefix && !prefix->stopped.empty();
  };
  EXPECT_TRUE(stops(gtb_chunk_bytes({GtbChunkType::kGeometry, 0, 4097, {}})));
  EXPECT_TRUE(stops(gtb_chunk_bytes({GtbChunkType::kGeometry, 0, 0, {}})));
  EXPECT_TRUE(stops(gtb_chunk_bytes({static_cast<GtbChunkType>('X'), 0, 1, {}})));
  EXPECT_TRUE(stops(gtb_chunk_bytes({GtbChunkType::kEnd, 0, 0, {1, 2}})));
  EXPECT_TRUE(stops(std::string("G\0\x02\xff\xff\xff\xff\x0f", 8)));                    // 4 GiB payload
  EXPECT_TRUE(stops(std::string("G\0\xff\xff\xff\xff\xff\xff\x01", 9)));                // endless count
  EXPECT_TRUE(stops(std::string("G\0\x82\0\0", 5)));                                    // count in a long spelling
  const std::string metadata = gtb_metadata_bytes({});
  EXPECT_TRUE(stops(metadata + metadata));
  EXPECT_TRUE(stops(gtb_chunk_bytes({GtbChunkType::kMetadata, 0, 0, {'[', '1'}})));
  EXPECT_TRUE(stops(gtb_chunk_bytes({GtbChunkType::kMetadata, 0, 0, std::vector<std::uint8_t>(60000, '[')})));
  EXPECT_TRUE(stops(gtb_chunk_bytes({GtbChunkType::kGeometry, 0, 2, {}}) + metadata));
}

// Bytes changed at random, checksums made good again, so that the damage reaches the decoder.
TEST(GtbFormat, SurvivesDamageWithGoodChecksums) {
  const Sample s = sample(33, 40);
  const GtbStream clean = decode_gtb(bytes_of(s.bytes))->stream;
  std::mt19937 random(77);
  for (int round = 0; round < 400; ++round) {
    GtbStream stream = clean;
    for (int damage = 0; damage < 1 + static_cast<int>(random() % 4); ++damage) {
      GtbChunk& chunk = stream.chunks[random() % stream.chunks.size()];
      switch (random() % 5) {
        case 0: chunk.count = static_cast<std::uint32_t>(random() % 5000); break;
        case 1: chunk.level = static_cast<std::uint8_t>(random()); break;
        case 2: std::swap(chunk, stream.chunks[random() % stream.chunks.size()]); break;
        default:
          if (!chunk.payload.empty()) chunk.payload[random() % chunk.payload.size()] = static_cast<std::uint8_t>(random());
      }
    }
    const std::optional<Decoded> part = decoded(bytes_of(encode_gtb(stream)));
    ASSERT_TRUE(part);
    ASSERT_EQ(test::mesh_fault(bitree_mesh(part->model.tree())), "");
    for (const std::uint8_t k : part->model.class_map()) ASSERT_LT(k, part->model.patterns().size());
  }
}

// Random bytes behind the magic, of every small length.
TEST(GtbFormat, RefusesNoise) {
  std::mt19937 random(5);
  for (int round = 0; round < 3000; ++round) {
    std::vector<std::uint8_t> bytes(random() % 200);
    for (std::uint8_t& byte : bytes) byte = static_cast<std::uint8_t>(random());
    for (std::size_t i = 0; i < std::min<std::size_t>(4, bytes.size()) && round % 2 == 0; ++i) bytes[i] = static_cast<std::uint8_t>("GTB1"[i]);
    EXPECT_FALSE(decode_gtb(bytes));
  }
}

}  // namespace
}  // namespace lodestone
