#include "kernels/mesh/tin.h"

#include <gtest/gtest.h>

#include <limits>
#include <random>

#include "kernels/mesh/tile_border.h"
#include "kernels/mesh/triangle_scan.h"
#include "tests/support/mesh_check.h"
#include "tests/support/terrain.h"

namespace lodestone {
namespace {

using test::Kind;

TinRequest request_for(const std::vector<float>& heights, int posts, double error_m, int halo = 0) {
  TinRequest request;
  request.field = {heights, {}, posts, posts, halo};
  request.max_error_m = error_m;
  return request;
}

TinMesh built(const TinRequest& request) {
  Result<TinMesh> mesh = build_tin(request);
  if (!mesh) ADD_FAILURE() << mesh.error().message;
  return mesh ? std::move(*mesh) : TinMesh{};
}

TEST(TriangleScan, HasTheSameBitsForEveryInstructionSetAndMatchesAPlainLoop) {
  constexpr int kSide = 60;
  std::mt19937 random(7);
  for (const Kind kind : {Kind::kFloat, Kind::kInteger, Kind::kPlateau}) {
    std::vector<float> heights = test::heights_of(kind, 0, 0, kSide, kSide, 0, 3);
    for (int k = 0; k < 200; ++k)
      heights[random() % heights.size()] = std::numeric_limits<float>::quiet_NaN();
    heights.resize(heights.size() + kScanPadding, 0);
    const ScanField field{heights.data(), kSide};
    for (int k = 0; k < 2000; ++k) {
      ScanPoint p[3];
      for (ScanPoint& q : p) {
        q = {static_cast<int>(random() % kSide), static_cast<int>(random() % kSide), 0};
        q.height_m = test::sample_m(kind, q.col, q.row, 3);
      }
      const auto cross = [](const ScanPoint& a, const ScanPoint& b, int c, int r) {
        return static_cast<std::int64_t>(b.row - a.row) * (c - a.col) -
               static_cast<std::int64_t>(b.col - a.col) * (r - a.row);
      };
      const std::int64_t area = cross(p[0], p[1], p[2].col, p[2].row);
      if (area == 0) continue;
      const ScanResult result = detail::scan_triangle_at(0, field, p[0], p[1], p[2]);
      for (const int width : {1, 2}) {
        const ScanResult other = detail::scan_triangle_at(width, field, p[0], p[1], p[2]);
        ASSERT_EQ(result.error_m, other.error_m);
        ASSERT_EQ(result.sum2_m2, other.sum2_m2);
        ASSERT_EQ(result.col, other.col);
        ASSERT_EQ(result.row, other.row);
      }
      double worst = 0, sum2 = 0;
      for (int r = 0; r < kSide; ++r) {
        for (int c = 0; c < kSide; ++c) {
          std::int64_t w[3] = {cross(p[1], p[2], c, r), cross(p[2], p[0], c, r), cross(p[0], p[1], c, r)};
          for (std::int64_t& x : w) x = area < 0 ? -x : x;
          const float h = heights[static_cast<std::size_t>(r * kSide + c)];
          if (w[0] < 0 || w[1] < 0 || w[2] < 0 || std::isnan(h)) continue;
          const double z = (w[0] * p[0].height_m + w[1] * p[1].height_m + w[2] * p[2].height_m) /
                           static_cast<double>(std::abs(area));
          worst = std::max(worst, std::abs(z - h));
          sum2 += (z - h) * (z - h);
        }
      }
      ASSERT_NEAR(result.error_m, worst, 1e-9 * (1 + worst));
      ASSERT_NEAR(result.sum2_m2, sum2, 1e-9 * (1 + sum2));
    }
  }
}

TEST(TriangleScan, NamesTheFirstOfEqualErrors) {
  std::vector<float> heights(9 * 9 + kScanPadding, 0);
  for (const auto& [c, r] : {std::pair{5, 6}, {3, 2}, {7, 2}, {1, 5}})
    heights[static_cast<std::size_t>(r * 9 + c)] = 4;
  const ScanResult result = scan_triangle({heights.data(), 9}, {0, 0, 0}, {0, 8, 0}, {8, 0, 0});
  EXPECT_EQ(result.error_m, 4);
  EXPECT_EQ(result.col, 3);
  EXPECT_EQ(result.row, 2);
}

TEST(TileBorder, KeepsEndsRequiredPostsAndTheBound) {
  const std::vector<float> flat(17, 5);
  EXPECT_EQ(simplify_edge(flat, {}, {}, 0), (std::vector<std::int32_t>{0, 16}));
  std::vector<std::uint8_t> required(17, 0);
  required[5] = 1;
  EXPECT_EQ(simplify_edge(flat, required, {}, 0), (std::vector<std::int32_t>{0, 5, 16}));
  const std::vector<float> tent{0, 1, 2, 3, 4, 3, 2, 1, 0};
  EXPECT_EQ(simplify_edge(tent, {}, {}, 0.5), (std::vector<std::int32_t>{0, 4, 8}));
  EXPECT_EQ(simplify_edge(tent, {}, {}, 4),
            (std::vector<std::int32_t>{0, 8}));  // an error equal to the bound is allowed
  const std::vector<float> two{0, 3, 0, 0, 0, 3, 0};
  EXPECT_EQ(simplify_edge(two, {}, {}, 2.0), (std::vector<std::int32_t>{0, 1, 2, 5, 6}));
}

class EveryTerrain : public testing::TestWithParam<std::tuple<Kind, TinCriterion, double>> {};

TEST_P(EveryTerrain, KeepsItsBoundAndIsAProperMesh) {
  const auto [kind, criterion, bound] = GetParam();
  const std::vector<float> heights = test::heights_of(kind, 1000, -500, 97, 97, 0, 11);
  TinRequest request = request_for(heights, 97, bound);
  request.criterion = criterion;
  const TinMesh mesh = built(request);
  EXPECT_EQ(test::mesh_fault(mesh), "");
  const auto [worst, rms] = test::rasterised_error(mesh, heights);
  EXPECT_LE(worst, bound * (1 + 1e-12) + 1e-9);
  EXPECT_NEAR(mesh.max_error_m, worst, 1e-9 * (1 + worst));
  EXPECT_NEAR(mesh.rms_error_m, rms, 1e-9 * (1 + rms));
  for (const TinVertex& v : mesh.vertices)
    EXPECT_EQ(v.height_m, heights[static_cast<std::size_t>(v.row * 97 + v.col)]);
  if (kind == Kind::kFlat || kind == Kind::kPlane) {
    EXPECT_EQ(mesh.triangle_count(), 2U);
    EXPECT_EQ(mesh.max_error_m, 0);
  }
  const std::size_t border = [&] {
    std::size_t n = 0;
    for (const TinVertex& v : mesh.vertices) n += v.col == 0 || v.row == 0 || v.col == 96 || v.row == 96;
    return n;
  }();
  EXPECT_EQ(mesh.triangle_count(), 2 * mesh.vertex_count() - 2 - border);
}
INSTANTIATE_TEST_SUITE_P(
    Tin, EveryTerrain,
    testing::Combine(testing::Values(Kind::kFloat, Kind::kInteger, Kind::kPlateau, Kind::kFlat, Kind::kPlane),
                     testing::Values(TinCriterion::kDataDependent, TinCriterion::kDelaunay),
                     testing::Values(0.0, 1.0, 7.0, 30.0, 1e9)));

TEST(Tin, NeighboursHaveIdenticalBorderVertices) {
  constexpr int kPosts = 33;
  for (int pair = 0; pair < 250; ++pair) {
    const Kind kind = pair % 3 == 0 ? Kind::kFloat : pair % 3 == 1 ? Kind::kInteger : Kind::kPlateau;
    const double bounds[] = {0, 0.5, 3, 10, 60};
    const bool is_budget = pair % 4 == 3;
    const std::int64_t i0 = pair * 32, j0 = -pair * 64;
    const auto mesh_at = [&](std::int64_t i, std::int64_t j) {
      const std::vector<float> heights = test::heights_of(kind, i, j, kPosts, kPosts, 0, 5);
      TinRequest request = request_for(heights, kPosts, bounds[pair % 5]);
      request.i0 = i;
      request.j0 = j;
      if (is_budget) {
        request.edge_error_m = bounds[pair % 5];
        request.max_error_m.reset();
        request.max_triangles =
            static_cast<std::size_t>(50 + (i + 7 * j) % 13);  // budgets differ, borders must not
      }
      return built(request);
    };
    const TinMesh here = mesh_at(i0, j0), east = mesh_at(i0 + 32, j0), south = mesh_at(i0, j0 + 32);
    EXPECT_EQ(test::side_of(here, border_of(here).east, true),
              test::side_of(east, border_of(east).west, true))
        << pair;
    EXPECT_EQ(test::side_of(here, border_of(here).south, false),
              test::side_of(south, border_of(south).north, false))
        << pair;
  }
}

TEST(Tin, StaysWithinItsBudgetAndIsNeverWorseThanASmallerOne) {
  const std::vector<float> heights = test::heights_of(Kind::kInteger, 0, 0, 65, 65, 0, 9);
  double last = std::numeric_limits<double>::infinity();
  for (std::size_t budget = 100; budget < 1500; budget += 100) {
    TinRequest request = request_for(heights, 65, 0);
    request.max_error_m.reset();
    request.edge_error_m = 25;
    request.max_triangles = budget;
    const TinMesh mesh = built(request);
    EXPECT_LE(mesh.triangle_count(), budget);
    EXPECT_LE(mesh.max_error_m, last);
    EXPECT_EQ(test::mesh_fault(mesh), "");
    last = mesh.max_error_m;
  }
}

TEST(Tin, DataDependentNeedsFewerTrianglesThanDelaunay) {
  double product = 1;
  int count = 0;
  for (const std::uint64_t seed : {1, 2, 3}) {
    const std::vector<float> heights = test::heights_of(Kind::kFloat, 0, 0, 129, 129, 0, seed);
    for (const double bound : {8.0, 25.0}) {
      TinRequest request = request_for(heights, 129, bound);
      const double ours = static_cast<double>(built(request).triangle_count());
      request.criterion = TinCriterion::kDelaunay;
      product *= ours / static_cast<double>(built(request).triangle_count());
      ++count;
    }
  }
  EXPECT_LT(std::pow(product, 1.0 / count), 0.95);
}

TEST(Tin, WorksOnRectanglesAndTinyFields) {
  for (const auto& [cols, rows] : {std::pair{2, 2}, {2, 9}, {9, 2}, {3, 3}, {130, 7}}) {
    const std::vector<float> heights = test::heights_of(Kind::kInteger, 0, 0, cols, rows, 0, 4);
    TinRequest request;
    request.field = {heights, {}, cols, rows, 0};
    request.max_error_m = 0;
    const TinMesh mesh = built(request);
    EXPECT_EQ(test::mesh_fault(mesh), "") << cols << " x " << rows;
    EXPECT_LE(test::rasterised_error(mesh, heights)[0], 1e-9);
  }
}

TEST(Tin, LeavesHolesWhereThereAreVoids) {
  constexpr int kPosts = 33;
  std::vector<float> heights = test::heights_of(Kind::kFloat, 0, 0, kPosts, kPosts, 0, 2);
  std::vector<std::uint8_t> is_void(heights.size(), 0);
  const auto is_void_post = [](int c, int r) {
    return (c >= 10 && c <= 14 && r >= 5 && r <= 20) || (r >= 28 && c < 6) || (c == 20 && r == 20);
  };
  for (int r = 0; r < kPosts; ++r) {
    for (int c = 0; c < kPosts; ++c) {
      if (!is_void_post(c, r)) continue;
      is_void[static_cast<std::size_t>(r * kPosts + c)] = 1;
      heights[static_cast<std::size_t>(r * kPosts + c)] = -9000;
    }
  }
  TinRequest request = request_for(heights, kPosts, 5);
  request.field.is_void = is_void;
  request.voids = TinVoids::kHole;
  const TinMesh mesh = built(request);
  EXPECT_EQ(test::mesh_fault(mesh, true), "");
  std::int64_t area = 0, expected = 0;
  for (std::size_t t = 0; t < mesh.top_triangles; ++t) area += test::area2_of(mesh, t);
  for (int r = 0; r + 1 < kPosts; ++r) {
    for (int c = 0; c + 1 < kPosts; ++c) {
      const bool is_hole = is_void_post(c, r) || is_void_post(c + 1, r) || is_void_post(c, r + 1) ||
                           is_void_post(c + 1, r + 1);
      expected += is_hole ? 0 : 2;
    }
  }
  EXPECT_EQ(area, expected);
  for (const TinVertex& v : mesh.vertices) EXPECT_GT(v.height_m, -8000);
  EXPECT_LE(mesh.max_error_m, 5);
}

TEST(Tin, SkirtsHangOutwardsBelowTheBorderAndLeaveTheTopAlone) {
  const std::vector<float> heights = test::heights_of(Kind::kFloat, 0, 0, 33, 33, 0, 2);
  TinMesh mesh = built(request_for(heights, 33, 20));
  set_normals(mesh, {heights, {}, 33, 33, 0}, 10, 10);
  const TinMesh bare = mesh;
  add_skirt(mesh, 12.5F);
  EXPECT_EQ(mesh.top_triangles, bare.triangle_count());
  EXPECT_TRUE(std::equal(bare.triangles.begin(), bare.triangles.end(), mesh.triangles.begin()));
  EXPECT_EQ(mesh.normals.size(), 3 * mesh.vertex_count());
  const TinBorder border = border_of(mesh);
  const std::size_t edges =
      border.west.size() + border.south.size() + border.east.size() + border.north.size() - 4;
  EXPECT_EQ(mesh.triangle_count() - mesh.top_triangles, 2 * edges);
  EXPECT_EQ(mesh.vertex_count() - mesh.top_vertices, edges);
  for (std::size_t t = mesh.top_triangles; t < mesh.triangle_count(); ++t) {
    const TinVertex &a = mesh.vertices[mesh.triangles[3 * t]], &b = mesh.vertices[mesh.triangles[3 * t + 1]],
                    &c = mesh.vertices[mesh.triangles[3 * t + 2]];
    const double bx = b.col - a.col, by = a.row - b.row, bz = b.height_m - a.height_m;
    const double cx = c.col - a.col, cy = a.row - c.row, cz = c.height_m - a.height_m;
    const double east = by * cz - bz * cy, north = bz * cx - bx * cz;
    const double to_x = a.col + b.col + c.col - 48.0, to_y = 48.0 - a.row - b.row - c.row;
    EXPECT_GT(east * to_x + north * to_y, 0) << t;
  }
  // The whole is closed but for the lower rim: every top edge has its partner.
  std::set<std::pair<std::uint32_t, std::uint32_t>> directed;
  for (std::size_t k = 0; k < mesh.triangles.size(); ++k)
    directed.insert({mesh.triangles[k], mesh.triangles[k % 3 == 2 ? k - 2 : k + 1]});
  for (const auto& [a, b] : directed) {
    if (a < mesh.top_vertices || b < mesh.top_vertices) {
      EXPECT_TRUE(directed.count({b, a}));
    }
  }
}

TEST(Tin, NormalsAgreeOnSharedEdgesAndFollowTheSlope) {
  const std::vector<float> west = test::heights_of(Kind::kFloat, 0, 0, 33, 33, 1, 6),
                           east = test::heights_of(Kind::kFloat, 32, 0, 33, 33, 1, 6);
  const PostField west_field{west, {}, 33, 33, 1}, east_field{east, {}, 33, 33, 1};
  TinMesh a = built(request_for(west, 33, 10, 1)), b = built(request_for(east, 33, 10, 1));
  set_normals(a, west_field, 30, 20);
  set_normals(b, east_field, 30, 20);
  const TinBorder at_a = border_of(a), at_b = border_of(b);
  ASSERT_EQ(at_a.east.size(), at_b.west.size());
  for (std::size_t k = 0; k < at_a.east.size(); ++k) {
    for (std::size_t i = 0; i < 3; ++i)
      EXPECT_EQ(a.normals[3 * at_a.east[k] + i], b.normals[3 * at_b.west[k] + i]);
  }
  const std::vector<float> plane =
      test::heights_of(Kind::kPlane, 0, 0, 9, 9, 0, 0);  // 3 m up per post east, 2 m up per post north
  TinMesh p = built(request_for(plane, 9, 0));
  set_normals(p, {plane, {}, 9, 9, 0}, 1, 1);
  EXPECT_FLOAT_EQ(p.normals[0], static_cast<float>(-3 / std::sqrt(14.0)));
  EXPECT_FLOAT_EQ(p.normals[1], static_cast<float>(-2 / std::sqrt(14.0)));
  EXPECT_FLOAT_EQ(p.normals[2], static_cast<float>(1 / std::sqrt(14.0)));
}

TEST(Tin, GridMeshIsRegularAndMeasured) {
  const std::vector<float> heights = test::heights_of(Kind::kFloat, 0, 0, 33, 33, 0, 2);
  const PostField field{heights, {}, 33, 33, 0};
  const Result<TinMesh> full = build_grid_mesh(field, 0, 0, 1), coarse = build_grid_mesh(field, 0, 0, 8);
  ASSERT_TRUE(full && coarse);
  EXPECT_EQ(full->max_error_m, 0);
  EXPECT_EQ(full->triangle_count(), 2048U);
  EXPECT_EQ(coarse->triangle_count(), 32U);
  EXPECT_EQ(test::mesh_fault(*coarse), "");
  EXPECT_NEAR(coarse->max_error_m, test::rasterised_error(*coarse, heights)[0], 1e-9);
  EXPECT_FALSE(build_grid_mesh(field, 0, 0, 5));
  EXPECT_FALSE(build_grid_mesh(field, 0, 0, 0));
}

TEST(Tin, RefusesWhatItCannotMesh) {
  std::vector<float> heights(9, 1);
  TinRequest good = request_for(heights, 3, 1);
  EXPECT_TRUE(build_tin(good));
  TinRequest bad = good;
  bad.max_error_m = -1;
  EXPECT_FALSE(build_tin(bad));
  bad = good;
  bad.max_error_m = std::nan("");
  EXPECT_FALSE(build_tin(bad));
  bad = good;
  bad.max_error_m.reset();
  EXPECT_FALSE(build_tin(bad));
  bad.max_triangles = 10;
  EXPECT_FALSE(build_tin(bad)) << "a budget needs an edge bound";
  bad.edge_error_m = 1;
  EXPECT_TRUE(build_tin(bad));
  bad = good;
  bad.field.cols = 4;
  EXPECT_FALSE(build_tin(bad));
  bad = good;
  bad.zones = ZoneField{};
  EXPECT_FALSE(build_tin(bad));
  const std::vector<std::uint16_t> labels{0, 1, 2, 128};
  bad.zones->labels = labels;
  EXPECT_FALSE(build_tin(bad));
  heights[4] = std::numeric_limits<float>::quiet_NaN();
  EXPECT_FALSE(build_tin(good));
}

}  // namespace
}  // namespace lodestone
