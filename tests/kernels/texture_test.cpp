#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <random>
#include <set>

#include "kernels/texture/crf_lifting.h"
#include "kernels/texture/gtb_model.h"
#include "kernels/texture/segmentation.h"
#include "kernels/texture/texture_synthesis.h"
#include "tests/support/gtb_samples.h"

namespace lodestone {
namespace {

TEST(CrfLifting, TransformsTheKnownLineAndBack) {
  std::vector<double> x{3, 1, 4, 1, 5, 9, 2, 6, 5};
  const std::vector<double> expected{1.9844, 1.8828, 5.5781, 4.6172, 5.8594, -2.375, -3.75, 5.625, 2.5}, before = x;
  crf137_forward(x);
  for (std::size_t i = 0; i < x.size(); ++i) EXPECT_NEAR(x[i], expected[i], 5e-5) << i;
  crf137_inverse(x);
  for (std::size_t i = 0; i < x.size(); ++i) EXPECT_NEAR(x[i], before[i], 1e-12) << i;
}

TEST(CrfLifting, InvertsEverySizeAndKeepsConstants) {
  std::mt19937 random(2);
  for (int size = 1; size <= 40; ++size) {
    std::vector<double> x, flat(static_cast<std::size_t>(size), 7);
    for (int i = 0; i < size; ++i) x.push_back(random() % 256);
    const std::vector<double> before = x;
    crf137_forward(x);
    crf137_inverse(x);
    for (std::size_t i = 0; i < x.size(); ++i) EXPECT_NEAR(x[i], before[i], 1e-10) << size;
    crf137_forward(flat);
    for (std::size_t i = 0; i < flat.size(); ++i) EXPECT_NEAR(flat[i], i < flat.size() - flat.size() / 2 ? 7 : 0, 1e-12) << size;
  }
  const RgbImage image = test::patchy_image(37, 22);
  EXPECT_EQ(rgb_image_of(image_of_pyramid(colour_pyramid(colour_band_of(image), 3))), image);
}

TEST(Isodata, FindsClustersThatLieApartAndIsStable) {
  std::mt19937 random(9);
  std::vector<Colour> samples;
  std::vector<int> truth;
  for (int i = 0; i < 600; ++i) {
    const int k = static_cast<int>(random() % 3);
    truth.push_back(k);
    Colour c{};
    for (std::size_t b = 0; b < 3; ++b) c[b] = 80.0 * k + random() % 16;
    samples.push_back(c);
  }
  const Clusters clusters = isodata(samples, {});
  EXPECT_EQ(clusters.centres.size(), 3U);
  std::array<std::set<int>, 3> labels;
  for (std::size_t i = 0; i < samples.size(); ++i) labels[static_cast<std::size_t>(truth[i])].insert(clusters.labels[i]);
  for (const std::set<int>& own : labels) EXPECT_EQ(own.size(), 1U);
  EXPECT_EQ(isodata(samples, {}).labels, clusters.labels);
  EXPECT_TRUE(isodata({}, {}).centres.empty());
  EXPECT_EQ(isodata(std::vector<Colour>(5, Colour{1, 2, 3}), {}).centres.size(), 1U);
}

TEST(TextureTrees, MatchTheKnownColumns) {
  const std::vector<std::uint8_t> map{0, 0, 1, 1, 0, 0, 1, 1, 0, 0, 1, 1, 0, 0, 1, 1};
  for (const auto& [share, visited, leaves] : {std::tuple{0.9, 10, 6}, {1.0, 10, 6}, {0.5, 2, 2}}) {
    const TextureTriangles count = count_texture_triangles(build_texture_tree(map, 4, 4, share));
    EXPECT_EQ(count.visited, static_cast<std::size_t>(visited)) << share;
    EXPECT_EQ(count.leaves, static_cast<std::size_t>(leaves)) << share;
  }
}

TEST(TextureTrees, LeavesPaintEveryPixelOnce) {
  for (int n = 0; n <= 4; ++n) {
    for (int level = 0; level <= 2 * n; ++level) {
      std::vector<int> hits(std::size_t{1} << 2 * n, 0);
      for (std::uint32_t index = 0; index < 2U << level; ++index) {
        std::vector<std::uint8_t> pixels(hits.size(), 0);
        paint_texture_triangle(n, level, index, 1, pixels, 1 << n, 1 << n);
        for (std::size_t at = 0; at < hits.size(); ++at) hits[at] += pixels[at];
      }
      for (const int hit : hits) ASSERT_EQ(hit, 1) << n << " " << level;
    }
  }
}

TEST(Segmentation, GivesEveryClassAPatternOfItsMeanColour) {
  const RgbImage image = test::patchy_image(150, 117);
  const Result<TextureSegmentation> result = segment_texture(image);
  ASSERT_TRUE(result);
  EXPECT_GE(result->classes_before, result->means.size());
  EXPECT_GE(result->means.size(), 3U);
  ASSERT_EQ(result->patterns.size(), result->means.size());
  for (std::size_t k = 0; k < result->means.size(); ++k) {
    const RgbImage& pattern = result->patterns[k];
    EXPECT_TRUE(pattern.width == 16 || pattern.width == 8);
    Colour mean{}, of_class{};
    double pixels = 0;
    for (std::size_t at = 0; at < pattern.rgb.size(); ++at) mean[at % 3] += pattern.rgb[at];
    for (std::size_t at = 0; at < result->classes.size(); ++at) {
      if (result->classes[at] != k) continue;
      ++pixels;
      for (std::size_t c = 0; c < 3; ++c) of_class[c] += image.rgb[3 * at + c];
    }
    ASSERT_GT(pixels, 0);
    for (std::size_t c = 0; c < 3; ++c) {
      EXPECT_NEAR(of_class[c] / pixels, result->means[k][c], 1e-9);
      EXPECT_NEAR(mean[c] / (pattern.width * pattern.width), result->means[k][c], 0.6);
    }
  }
  EXPECT_FALSE(segment_texture(RgbImage{7, 9, std::vector<std::uint8_t>(189)}));
  EXPECT_FALSE(segment_texture(RgbImage{9, 9, std::vector<std::uint8_t>(12)}));
  EXPECT_EQ(segment_texture(RgbImage{8, 8, std::vector<std::uint8_t>(192, 90)})->means.size(), 1U);
}

TEST(Synthesis, RandomNumbersAreTheKnownOnes) {
  TextureRandom random(std::array<std::uint64_t, 3>{1, 2, 3});
  EXPECT_EQ(random.next(), 0x12588d809dce88a7ULL);
  EXPECT_EQ(random.next(), 0xdd034ea7d44e8739ULL);
  EXPECT_EQ(random.next(), 0x5b70c9b40c7440b6ULL);
}

TEST(Synthesis, PermutationKeepsEveryClassOfEveryBand) {
  const RgbImage pattern = test::patchy_image(16, 16, 5);
  const PyramidClasses classes = classify_pattern(pattern);
  EXPECT_EQ(classes.depth, 3);
  for (const PermutationMode mode : {PermutationMode::kFull, PermutationMode::kFiftySwaps}) {
    const ColourPyramid before = colour_pyramid(colour_band_of(pattern), classes.depth);
    ColourPyramid after = before;
    permute_pyramid(after, classes, 42, 8, mode);
    std::size_t moved = 0;
    const auto compare = [&](const ColourBand& a, const ColourBand& b, const std::vector<std::uint16_t>& labels) {
      std::multiset<std::array<double, 4>> from, to;   // the three colours move together
      for (std::size_t at = 0; at < labels.size(); ++at) {
        from.insert({static_cast<double>(labels[at]), a.plane[0][at], a.plane[1][at], a.plane[2][at]});
        to.insert({static_cast<double>(labels[at]), b.plane[0][at], b.plane[1][at], b.plane[2][at]});
        moved += a.plane[0][at] != b.plane[0][at] ? 1 : 0;
      }
      EXPECT_EQ(from, to);
    };
    compare(before.low, after.low, classes.bands[0].labels);
    for (std::size_t level = 0; level < 3; ++level) {
      for (std::size_t band = 0; band < 3; ++band) compare(before.details[level][band], after.details[level][band], classes.bands[1 + 3 * (2 - level) + band].labels);
    }
    EXPECT_GT(moved, 20U);
  }
}

TEST(Synthesis, SameSeedSameBytesOtherSeedOtherBytes) {
  const RgbImage pattern = test::patchy_image(16, 16, 5);
  const Result<RgbImage> a = synthesise_texture(pattern, 100, {7, 3}), b = synthesise_texture(pattern, 100, {7, 3}), c = synthesise_texture(pattern, 100, {8, 3});
  ASSERT_TRUE(a && b && c);
  EXPECT_EQ(a->width, 128);
  EXPECT_EQ(*a, *b);
  EXPECT_NE(*a, *c);
  EXPECT_EQ(*synthesise_texture(pattern, 16, {7, 3}), pattern);
  EXPECT_FALSE(synthesise_texture(RgbImage{12, 12, std::vector<std::uint8_t>(432)}, 50, {}));
}

TEST(Synthesis, NeighbouringMapsJoin) {
  const std::vector<RgbImage> patterns{test::patchy_image(16, 16, 5), test::patchy_image(8, 8, 6)};
  std::vector<std::uint8_t> whole(64 * 32), west, east;
  for (int row = 0; row < 32; ++row) {
    for (int col = 0; col < 64; ++col) {
      const auto k = static_cast<std::uint8_t>(test::terrain_m(col, row, 3) > 0);
      whole[static_cast<std::size_t>(row * 64 + col)] = k;
      (col < 32 ? west : east).push_back(k);
    }
  }
  const Result<RgbImage> all = render_texture(whole, 64, 32, patterns, 64, 9, 100, 1), w = render_texture(west, 32, 32, patterns, 64, 9, 100, 1),
                         e = render_texture(east, 32, 32, patterns, 64, 9, 132, 1);
  ASSERT_TRUE(all && w && e);
  for (int row = 0; row < 32; ++row) {
    for (int col = 0; col < 64; ++col) {
      const RgbImage& part = col < 32 ? *w : *e;
      for (std::size_t c = 0; c < 3; ++c) ASSERT_EQ(all->rgb[all->index(row, col) + c], part.rgb[part.index(row, col % 32) + c]);
    }
  }
  EXPECT_FALSE(render_texture(std::vector<std::uint8_t>{2}, 1, 1, patterns, 16, 0, 0, 1));
}

TEST(GtbModel, RoundTripIsExactAndEveryChunkCountIsAModel) {
  for (const auto& [side, width, height] : {std::tuple{65, 100, 71}, {33, 0, 0}, {0, 130, 64}, {129, 16, 16}, {9, 200, 200}}) {
    const Bitree tree = side > 0 ? test::terrain_tree(side, 2, 1) : Bitree{};
    std::optional<TextureModel> texture;
    std::vector<std::uint8_t> map;
    if (width > 0) {
      const Result<TextureSegmentation> segmentation = segment_texture(test::patchy_image(width, height, 3));
      ASSERT_TRUE(segmentation);
      map = segmentation->classes;
      texture = *texture_model_of(*segmentation, 1.0);
    }
    const GtbStream stream = encode_gtb_model(side > 0 ? &tree : nullptr, texture ? &*texture : nullptr);
    Result<GtbModelDecoder> decoder = GtbModelDecoder::open(stream.header);
    ASSERT_TRUE(decoder);
    for (const GtbChunk& chunk : stream.chunks) {
      EXPECT_FALSE(decoder->is_complete());
      const Result<void> taken = decoder->accept(chunk);
      ASSERT_TRUE(taken) << Result<void>(taken).error().message;
      if (side > 0) {
        Bitree part = decoder->tree(), closed = part;
        close_bitree(closed);
        for (std::size_t at = 0; at < part.state.size(); ++at) {
          if (closed.state[at] != BitreeState::kNone) {
            ASSERT_NE(part.state[at], BitreeState::kNone) << "not closed";
          }
        }
      }
      for (const std::uint8_t k : decoder->class_map()) ASSERT_LT(k, decoder->patterns().size());
    }
    EXPECT_TRUE(decoder->is_complete());
    EXPECT_FALSE(decoder->accept(stream.chunks.back()));
    if (side > 0) {
      EXPECT_EQ(decoder->tree().state, tree.state);
      EXPECT_EQ(decoder->tree().q, tree.q);
      EXPECT_EQ(decoder->tree().fictitious, tree.fictitious);
    }
    if (!map.empty()) {
      const std::vector<std::uint8_t> back = decoder->class_map();
      ASSERT_EQ(back.size(), map.size());
      for (std::size_t at = 0; at < map.size(); ++at) ASSERT_EQ(decoder->patterns()[back[at]], texture->patterns[map[at]]) << at;
    }
  }
}

TEST(GtbModel, RefusesChunksOutOfOrderAndKeepsWhatItHad) {
  const Bitree tree = test::terrain_tree(33, 2, 1);
  const GtbStream stream = encode_gtb_model(&tree, nullptr);
  Result<GtbModelDecoder> decoder = GtbModelDecoder::open(stream.header);
  ASSERT_TRUE(decoder->accept(stream.chunks[0]));
  const Bitree before = decoder->tree();
  EXPECT_FALSE(decoder->accept(stream.chunks[2]));
  EXPECT_FALSE(decoder->accept(stream.chunks[1]));   // stopped for good
  EXPECT_EQ(decoder->tree().state, before.state);
  EXPECT_EQ(decoder->tree().q, before.q);

  // Heights that leave the lattice.
  GtbHeader header = stream.header;
  header.corner_q = {(1 << 26) - 1, (1 << 26) - 1, (1 << 26) - 1, (1 << 26) - 1};
  Result<GtbModelDecoder> wild = GtbModelDecoder::open(header);
  bool has_failed = false;
  for (const GtbChunk& chunk : stream.chunks) has_failed |= !wild->accept(chunk);
  EXPECT_TRUE(has_failed);
  for (const std::int32_t q : wild->tree().q) EXPECT_LT(std::abs(q), 1 << 26);
}

TEST(GtbModel, SurvivesRandomPayloads) {
  std::mt19937 random(31);
  const Bitree tree = test::terrain_tree(65, 1, 1);
  const Result<TextureSegmentation> segmentation = segment_texture(test::patchy_image(64, 64));
  const TextureModel texture = *texture_model_of(*segmentation, 1.0);
  const GtbStream stream = encode_gtb_model(&tree, &texture);
  int refused = 0;
  for (int round = 0; round < 300; ++round) {
    Result<GtbModelDecoder> decoder = GtbModelDecoder::open(stream.header);
    for (GtbChunk chunk : stream.chunks) {
      if (random() % 3 == 0) {
        for (std::uint8_t& byte : chunk.payload) byte = static_cast<std::uint8_t>(random());
        if (random() % 4 == 0) chunk.payload.resize(random() % 40);
        if (random() % 8 == 0) chunk.count = static_cast<std::uint32_t>(random());
        if (random() % 8 == 0) chunk.level = static_cast<std::uint8_t>(random());
      }
      if (decoder->accept(chunk)) continue;
      ++refused;
      break;
    }
    const Bitree part = decoder->tree();
    Bitree closed = part;
    close_bitree(closed);
    for (std::size_t at = 0; at < part.state.size(); ++at) {
      if (closed.state[at] != BitreeState::kNone) {
        ASSERT_NE(part.state[at], BitreeState::kNone);
      }
      ASSERT_LT(std::abs(part.q[at]), 1 << 26);
    }
    for (const std::uint8_t k : decoder->class_map()) ASSERT_LT(k, decoder->patterns().size());
  }
  EXPECT_GT(refused, 100);
}

}  // namespace
}  // namespace lodestone
