#include "storage/formats/quantized_mesh.h"

#include <gtest/gtest.h>

#include <cmath>
#include <cstdlib>
#include <fstream>
#include <random>

#include "kernels/mesh/tin.h"
#include "tests/support/jacksboro.h"
#include "tests/support/mesh_check.h"
#include "tests/support/terrain.h"

namespace lodestone {
namespace {

std::span<const std::uint8_t> bytes_of(const std::string& s) {
  return {reinterpret_cast<const std::uint8_t*>(s.data()), s.size()};
}

TinMesh meshed(const std::vector<float>& heights, int posts, double error_m, int halo) {
  TinRequest request;
  request.field = {heights, {}, posts, posts, halo};
  request.max_error_m = error_m;
  Result<TinMesh> mesh = build_tin(request);
  EXPECT_TRUE(mesh) << mesh.error().message;
  set_normals(*mesh, request.field, 75, 92);
  return std::move(*mesh);
}

std::vector<float> jacksboro_window(int posts) {
  const test::SampleDem dem = test::jacksboro();
  EXPECT_GT(dem.cols, 0) << "python-matplotlib-data is not installed; run config/set-up";
  return dem.window(30, 20, posts, 1);
}

const GeodeticFrame kFrame{-84.4140625, 36.5625, -84.375, 36.6015625, false};

TEST(QuantizedMesh, GivesBackTheMeshWithinItsStatedSlack) {
  const std::vector<float> heights = jacksboro_window(257);
  for (const double bound : {5.0, 20.0}) {
    const TinMesh mesh = meshed(heights, 257, bound, 1);
    const Result<std::string> bytes =
        encode_quantized_mesh(mesh, {kFrame, true, std::nullopt, R"({"error":5})"});
    ASSERT_TRUE(bytes) << bytes.error().message;
    const Result<DecodedQuantizedMesh> back = decode_quantized_mesh(bytes_of(*bytes));
    ASSERT_TRUE(back) << back.error().message;
    ASSERT_EQ(back->u.size(), mesh.vertex_count());
    ASSERT_EQ(back->indices.size(), mesh.triangles.size());
    EXPECT_EQ(back->metadata_json, R"({"error":5})");
    EXPECT_EQ(back->oct_normals.size(), 2 * mesh.vertex_count());
    // Same triangles corner for corner.
    const double step = (static_cast<double>(back->height_max_m) - back->height_min_m) / 32767;
    for (std::size_t k = 0; k < mesh.triangles.size(); ++k) {
      const TinVertex& p = mesh.vertices[mesh.triangles[k]];
      const std::uint32_t i = back->indices[k];
      ASSERT_EQ(back->u[i], std::lround(p.col * 32767 / 256.0));
      ASSERT_NEAR(back->v[i], (256 - p.row) * 32767 / 256.0, 0.51);
      ASSERT_NEAR(back->height_m(i), p.height_m, step / 2 + 1e-9);
    }
    // The decoded surface, sampled at the posts by barycentric coordinates in u, v.
    double worst = 0;
    for (std::size_t t = 0; t < back->indices.size() / 3; ++t) {
      const std::uint32_t a = back->indices[3 * t], b = back->indices[3 * t + 1],
                          c = back->indices[3 * t + 2];
      const auto x = [&](std::uint32_t i) { return back->u[i] * 256 / 32767.0; };
      const auto y = [&](std::uint32_t i) { return 256 - back->v[i] * 256 / 32767.0; };
      const double area = (x(b) - x(a)) * (y(c) - y(a)) - (x(c) - x(a)) * (y(b) - y(a));
      ASSERT_LT(area, 0) << "counter-clockwise with v up";
      for (int r = static_cast<int>(std::ceil(std::min({y(a), y(b), y(c)}) - 0.01));
           r <= std::max({y(a), y(b), y(c)}) + 0.01; ++r) {
        for (int col = static_cast<int>(std::ceil(std::min({x(a), x(b), x(c)}) - 0.01));
             col <= std::max({x(a), x(b), x(c)}) + 0.01; ++col) {
          const double wb = ((col - x(a)) * (y(c) - y(a)) - (x(c) - x(a)) * (r - y(a))) / area;
          const double wc = ((x(b) - x(a)) * (r - y(a)) - (col - x(a)) * (y(b) - y(a))) / area;
          if (wb < 0 || wc < 0 || wb + wc > 1) continue;
          const double z =
              (1 - wb - wc) * back->height_m(a) + wb * back->height_m(b) + wc * back->height_m(c);
          worst = std::max(worst, std::abs(z - heights[static_cast<std::size_t>((r + 1) * 259 + col + 1)]));
        }
      }
    }
    EXPECT_LE(worst, mesh.max_error_m + quantized_mesh_slack_m(mesh, kFrame));
    EXPECT_LT(quantized_mesh_slack_m(mesh, kFrame), 0.2 * bound);
  }
}

TEST(QuantizedMesh, EdgeListsAreExactlyTheVerticesOfEachSide) {
  const TinMesh mesh = meshed(jacksboro_window(129), 129, 10, 1);
  const Result<DecodedQuantizedMesh> back =
      decode_quantized_mesh(bytes_of(*encode_quantized_mesh(mesh, {kFrame, false, std::nullopt, ""})));
  ASSERT_TRUE(back);
  const auto expect_side = [&](const std::vector<std::uint32_t>& side,
                               const std::vector<std::uint16_t>& across, int at,
                               const std::vector<std::uint16_t>& along) {
    std::size_t count = 0;
    for (const std::uint16_t x : across) count += x == at;
    EXPECT_EQ(side.size(), count);
    for (std::size_t k = 0; k < side.size(); ++k) {
      EXPECT_EQ(across[side[k]], at);
      if (k > 0) {
        EXPECT_GT(along[side[k]], along[side[k - 1]]);
      }
    }
  };
  expect_side(back->west, back->u, 0, back->v);
  expect_side(back->east, back->u, 32767, back->v);
  expect_side(back->south, back->v, 0, back->u);
  expect_side(back->north, back->v, 32767, back->u);
}

TEST(QuantizedMesh, NeighboursMeetAtTheSamePlaces) {
  const test::SampleDem dem = test::jacksboro();
  const TinMesh west = meshed(dem.window(10, 10, 129, 1), 129, 8, 1),
                east = meshed(dem.window(138, 10, 129, 1), 129, 8, 1);
  const Result<DecodedQuantizedMesh> a =
      decode_quantized_mesh(bytes_of(*encode_quantized_mesh(west, {kFrame, true, std::nullopt, ""})));
  const Result<DecodedQuantizedMesh> b =
      decode_quantized_mesh(bytes_of(*encode_quantized_mesh(east, {kFrame, true, std::nullopt, ""})));
  ASSERT_EQ(a->east.size(), b->west.size());
  const double step = (a->height_max_m - a->height_min_m + b->height_max_m - b->height_min_m) / 32767.0;
  for (std::size_t k = 0; k < a->east.size(); ++k) {
    EXPECT_EQ(a->v[a->east[k]], b->v[b->west[k]]);
    EXPECT_NEAR(a->height_m(a->east[k]), b->height_m(b->west[k]), step / 2 + 1e-9);
  }
}

TEST(QuantizedMesh, HeaderEnclosesTheMeshAndItsOcclusionPointIsSafe) {
  const std::vector<float> heights = jacksboro_window(129);
  const TinMesh mesh = meshed(heights, 129, 10, 1);
  for (const GeodeticFrame& frame :
       {kFrame, GeodeticFrame{-180, -90, 0, 90, false}, GeodeticFrame{-90, -45, 0, 45, false},
        GeodeticFrame{10, 40, 55, 60, true}}) {
    const Result<DecodedQuantizedMesh> back =
        decode_quantized_mesh(bytes_of(*encode_quantized_mesh(mesh, {frame, false, std::nullopt, ""})));
    ASSERT_TRUE(back);
    const std::vector<Vec3> positions = ecef_positions(mesh, frame);
    for (const Vec3& p : positions) {
      EXPECT_LE(std::hypot(p[0] - back->sphere_centre[0], p[1] - back->sphere_centre[1],
                           p[2] - back->sphere_centre[2]),
                back->sphere_radius);
    }
    for (const double x : back->horizon_occlusion) ASSERT_TRUE(std::isfinite(x));
    if (frame.east_deg - frame.west_deg > 90) continue;  // no point stands for half the Earth
    // From any eye, if the point is behind the horizon, so is every vertex (all scaled to the unit sphere).
    constexpr double kX = 6378137.0, kZ = 6356752.3142451793;
    const auto is_hidden = [](const Vec3& eye, const Vec3& p) {
      const double vh2 = eye[0] * eye[0] + eye[1] * eye[1] + eye[2] * eye[2] - 1;
      const Vec3 to{p[0] - eye[0], p[1] - eye[1], p[2] - eye[2]};
      const double along = -(to[0] * eye[0] + to[1] * eye[1] + to[2] * eye[2]);
      return along > vh2 && along * along / (to[0] * to[0] + to[1] * to[1] + to[2] * to[2]) > vh2;
    };
    std::mt19937 random(3);
    std::uniform_real_distribution<double> any(-1, 1);
    int hidden = 0;
    for (int k = 0; k < 4000; ++k) {
      Vec3 eye{any(random), any(random), any(random)};
      const double size = std::hypot(eye[0], eye[1], eye[2]);
      const double scale = (1 + std::pow(10, -3 + 3 * std::abs(any(random)))) / size;
      for (double& e : eye) e *= scale;
      if (!is_hidden(eye, back->horizon_occlusion)) continue;
      ++hidden;
      for (const Vec3& p : positions)
        ASSERT_TRUE(is_hidden(eye, {p[0] / kX * 0.999999, p[1] / kX * 0.999999, p[2] / kZ * 0.999999}));
    }
    EXPECT_GT(hidden, 200);
  }
}

TEST(QuantizedMesh, NormalsSurviveTheOctahedron) {
  std::mt19937 random(5);
  std::normal_distribution<double> any;
  for (int k = 0; k < 2000; ++k) {
    Vec3 n{any(random), any(random), any(random)};
    const double size = std::hypot(n[0], n[1], n[2]);
    for (double& x : n) x /= size;
    const auto [x, y] = oct_encoded(n);
    const Vec3 back = oct_decoded(x, y);
    EXPECT_GT(n[0] * back[0] + n[1] * back[1] + n[2] * back[2], 0.9998);
  }
  EXPECT_EQ(oct_encoded({0, 0, 1}), (std::array<std::uint8_t, 2>{128, 128}));
}

TEST(QuantizedMesh, CarriesAWatermask) {
  const TinMesh mesh = meshed(jacksboro_window(33), 33, 10, 1);
  std::vector<std::uint8_t> mask(65536);
  for (std::size_t i = 0; i < mask.size(); ++i) mask[i] = static_cast<std::uint8_t>(i % 251);
  const Result<std::string> bytes =
      encode_quantized_mesh(mesh, {kFrame, true, std::span<const std::uint8_t>(mask), "{}"});
  ASSERT_TRUE(bytes);
  EXPECT_EQ(decode_quantized_mesh(bytes_of(*bytes))->watermask, mask);
  const std::vector<std::uint8_t> wrong(3);
  EXPECT_FALSE(encode_quantized_mesh(mesh, {kFrame, true, std::span<const std::uint8_t>(wrong), ""}));
  TinMesh bare = mesh;
  bare.normals.clear();
  EXPECT_FALSE(encode_quantized_mesh(bare, {kFrame, true, std::nullopt, ""}));
  EXPECT_FALSE(encode_quantized_mesh(TinMesh{}, {kFrame, false, std::nullopt, ""}));
}

TEST(QuantizedMesh, LeavesSkirtsToTheClient) {
  TinMesh mesh = meshed(jacksboro_window(33), 33, 10, 1);
  const std::string bare = *encode_quantized_mesh(mesh, {kFrame, true, std::nullopt, ""});
  add_skirt(mesh, 30);
  EXPECT_EQ(*encode_quantized_mesh(mesh, {kFrame, true, std::nullopt, ""}), bare);
}

TEST(QuantizedMesh, WritesWideIndicesForLargeMeshes) {
  const std::vector<float> heights = test::heights_of(test::Kind::kFloat, 0, 0, 257, 257, 0, 1);
  const TinMesh mesh = *build_grid_mesh({heights, {}, 257, 257, 0}, 0, 0, 1);
  const Result<DecodedQuantizedMesh> back =
      decode_quantized_mesh(bytes_of(*encode_quantized_mesh(mesh, {kFrame, false, std::nullopt, ""})));
  ASSERT_TRUE(back) << back.error().message;
  EXPECT_EQ(back->u.size(), 66049U);
  EXPECT_EQ(back->indices.size(), mesh.triangles.size());
  EXPECT_EQ(back->west.size(), 257U);
}

TEST(QuantizedMesh, DecoderSurvivesEveryPrefixAndManyWrongBytes) {
  const TinMesh mesh = meshed(jacksboro_window(17), 17, 10, 1);
  const std::vector<std::uint8_t> water{255};
  const std::string bytes =
      *encode_quantized_mesh(mesh, {kFrame, true, std::span<const std::uint8_t>(water), R"({"a":1})"});
  const Result<DecodedQuantizedMesh> whole = decode_quantized_mesh(bytes_of(bytes));
  ASSERT_TRUE(whole);
  int complete = 0;
  for (std::size_t n = 0; n < bytes.size(); ++n) {
    const std::vector<std::uint8_t> prefix(bytes.begin(), bytes.begin() + static_cast<std::ptrdiff_t>(n));
    complete += static_cast<bool>(decode_quantized_mesh(prefix));
  }
  EXPECT_EQ(complete, 3) << "only between extensions";
  for (std::size_t at = 0; at < bytes.size(); ++at) {
    for (const int flip : {1, 64, 255}) {
      std::vector<std::uint8_t> bad(bytes.begin(), bytes.end());
      bad[at] = static_cast<std::uint8_t>(bad[at] ^ flip);
      const Result<DecodedQuantizedMesh> result = decode_quantized_mesh(bad, 1 << 16);
      if (!result) continue;
      for (const std::uint32_t i : result->indices) ASSERT_LT(i, result->u.size());
    }
  }
  EXPECT_FALSE(decode_quantized_mesh(bytes_of(bytes), 4)) << "the limit holds";
}

// Files for the clients in tests/clients; kept when a folder is given.
TEST(QuantizedMesh, EveryExtensionSetDecodes) {
  const char* folder = std::getenv("LODESTONE_TERRAIN_OUT");
  const test::SampleDem dem = test::jacksboro();
  std::vector<std::uint8_t> mask(65536, 255);
  for (int k = 0; k < 24; ++k) {
    const std::vector<float> heights = dem.window(5 * k, 3 * k, 65, 1);
    const TinMesh mesh = meshed(heights, 65, 2 + 3 * k, 1);
    QuantizedMeshOptions options;
    options.frame = kFrame;
    options.has_normals = k & 1;
    if (k & 2) options.watermask = std::span<const std::uint8_t>(mask).first(k & 8 ? 1 : 65536);
    if (k & 4) options.metadata_json = R"({"geometricerror":)" + std::to_string(mesh.max_error_m) + "}";
    const Result<std::string> bytes = encode_quantized_mesh(mesh, options);
    ASSERT_TRUE(bytes);
    const Result<DecodedQuantizedMesh> back = decode_quantized_mesh(bytes_of(*bytes));
    ASSERT_TRUE(back);
    EXPECT_EQ(back->oct_normals.empty(), !options.has_normals);
    EXPECT_EQ(back->watermask.empty(), !options.watermask);
    if (folder == nullptr) continue;
    const std::string stem = std::string(folder) + "/" + std::to_string(k);
    std::ofstream(stem + ".terrain", std::ios::binary) << *bytes;
    // What our own reader sees, for other readers to agree with.
    std::ofstream plain(stem + ".txt");
    plain << back->u.size() << ' ' << back->indices.size() / 3 << '\n';
    for (std::size_t i = 0; i < back->u.size(); ++i)
      plain << back->u[i] << ' ' << back->v[i] << ' ' << back->height[i] << '\n';
    for (const std::uint32_t i : back->indices) plain << i << '\n';
    for (const auto* side : {&back->west, &back->south, &back->east, &back->north}) {
      plain << side->size();
      for (const std::uint32_t i : *side) plain << ' ' << i;
      plain << '\n';
    }
  }
}

}  // namespace
}  // namespace lodestone
