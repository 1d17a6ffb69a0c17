#include "kernels/mesh/bitree.h"

#include <gtest/gtest.h>

#include <limits>
#include <map>
#include <random>
#include <set>
#include <sstream>

#include "kernels/mesh/bitree_select.h"
#include "tests/support/mesh_check.h"
#include "tests/support/terrain.h"

namespace lodestone {
namespace {

using test::Kind;

BitreeRequest request_for(const std::vector<float>& heights, int side) {
  BitreeRequest request;
  request.field = {heights, {}, side, side, 0};
  return request;
}

Bitree built(const BitreeRequest& request) {
  Result<Bitree> tree = build_bitree(request);
  if (!tree) ADD_FAILURE() << tree.error().message;
  return tree ? std::move(*tree) : Bitree{};
}

Bitree tree_of(int n, const std::vector<std::pair<int, int>>& points, std::mt19937* random = nullptr) {
  Bitree tree;
  tree.n = n;
  tree.state.assign(static_cast<std::size_t>(tree.side() * tree.side()), BitreeState::kNone);
  tree.q.assign(tree.state.size(), 0);
  for (const auto& [row, col] : points) tree.state[tree.index(row, col)] = BitreeState::kSelected;
  close_bitree(tree);
  if (random != nullptr) {
    for (std::size_t at = 0; at < tree.q.size(); ++at) {
      if (tree.state[at] == BitreeState::kSelected) tree.q[at] = static_cast<std::int32_t>((*random)() % 1000);
    }
  }
  return tree;
}

std::string rows_of(const Bitree& tree) {
  std::string rows;
  for (int row = 0; row < tree.side(); ++row) {
    for (int col = 0; col < tree.side(); ++col) rows += tree.state[tree.index(row, col)] == BitreeState::kSelected ? '1' : '0';
    rows += row + 1 < tree.side() ? " " : "";
  }
  return rows;
}

TEST(BitreeWavelet, LiftsTheKnownLine) {
  std::vector<std::int32_t> x{3, 1, 4, 1, 5, 9, 2, 6, 5};
  cdf22_forward(x);
  EXPECT_EQ(x, (std::vector<std::int32_t>{2, 3, 6, 4, 7, -2, -3, 6, 3}));
}

TEST(BitreeWavelet, LiftsTheKnownSquare) {
  std::vector<std::int32_t> x{1, 2, 3, 4, 5, 2, 3, 4, 5, 6, 3, 4, 9, 6, 7, 4, 5, 6, 7, 8, 5, 6, 7, 8, 9};
  cdf22_forward_2d(x, 5, 5);
  EXPECT_EQ(x, (std::vector<std::int32_t>{2, 3, 6, 1, 1, 3, 8, 7, -1, -1, 6, 7, 10, 1, 1, 1, -1, 1, 1, 1, 1, -1, 1, 1, 1}));
}

TEST(BitreeWavelet, AHeightOffsetChangesNoCoefficient) {
  std::mt19937 random(3);
  for (int k = 0; k < 50; ++k) {
    std::vector<std::int32_t> x(17 * 17), y;
    for (std::int32_t& v : x) v = static_cast<std::int32_t>(random() % 100);
    const auto offset = static_cast<std::int32_t>(random() % 77) - 200;
    y = x;
    for (std::int32_t& v : y) v += offset;
    cdf22_forward_2d(x, 17, 17);
    cdf22_forward_2d(y, 17, 17);
    for (std::size_t at = 0; at < x.size(); ++at) EXPECT_EQ(y[at] - x[at], at % 17 < 9 && at / 17 < 9 ? offset : 0);
  }
}

TEST(BitreeSelection, MatchesTheKnownSpike) {
  std::vector<float> heights(81, 0);
  heights[3 * 9 + 5] = 7;
  BitreeRequest request = request_for(heights, 9);
  request.threshold_m = 0;
  request.wavelet_levels = 3;
  request.is_edge_shared = false;
  EXPECT_EQ(rows_of(built(request)), "100010101 000000000 000011111 000011110 100011101 000011000 000010100 000000000 100010001");
}

TEST(BitreeSelection, AFlatTileKeepsTheCoarsestLatticeAloneWithAndWithoutTheEdgeRule) {
  const std::vector<float> heights(33 * 33, 12);
  for (const bool is_shared : {false, true}) {
    for (int levels = 1; levels <= 5; ++levels) {
      BitreeRequest request = request_for(heights, 33);
      request.threshold_m = 0;
      request.wavelet_levels = levels;
      request.is_edge_shared = is_shared;
      const int per_side = (1 << (5 - levels)) + 1;
      EXPECT_EQ(built(request).selected, static_cast<std::size_t>(per_side * per_side));
    }
  }
  const std::vector<float> plane = test::heights_of(Kind::kPlane, 0, 0, 33, 33, 0, 0);
  BitreeRequest request = request_for(plane, 33);
  request.max_error_m = 0;
  const Bitree tree = built(request);
  EXPECT_EQ(tree.selected, 4U);
  EXPECT_EQ(bitree_mesh(tree).triangle_count(), 2U);
}

TEST(BitreeSelection, EdgeRuleMatchesTheKnownParabola) {
  const std::vector<double> heights{0, 1, 4, 9, 16, 9, 4, 1, 0};
  for (const auto& [tolerance, expected] : {std::pair{1.0, "101010101"}, {0.0, "111111111"}}) {
    std::vector<std::uint8_t> kept(9, 0);
    select_edge(heights, heights, kept, tolerance);
    std::string text;
    for (const std::uint8_t k : kept) text += k != 0 ? '1' : '0';
    EXPECT_EQ(text, expected) << tolerance;
  }
}

TEST(BitreeSelection, ALargerThresholdOrMoreLevelsKeepASubset) {
  const std::vector<float> heights = test::heights_of(Kind::kInteger, 40, 90, 65, 65, 0, 5);
  for (const bool is_shared : {false, true}) {
    std::vector<Bitree> trees;
    for (const auto& [threshold, levels] : {std::pair{0.0, 1}, {0.0, 2}, {0.0, 4}, {2.0, 4}, {9.0, 4}, {50.0, 4}, {50.0, 6}}) {
      BitreeRequest request = request_for(heights, 65);
      request.threshold_m = threshold;
      request.wavelet_levels = levels;
      request.is_edge_shared = is_shared;
      trees.push_back(built(request));
    }
    for (std::size_t k = 1; k < trees.size(); ++k) {
      EXPECT_LE(trees[k].selected, trees[k - 1].selected);
      for (std::size_t at = 0; at < trees[k].state.size() && !is_shared; ++at) {
        if (trees[k].state[at] == BitreeState::kSelected) {
          EXPECT_EQ(trees[k - 1].state[at], BitreeState::kSelected) << k << " " << at;
        }
      }
    }
  }
}

TEST(BitreeClosure, CallsInTheKnownPoints) {
  struct Case {
    std::pair<int, int> point;
    std::set<std::pair<int, int>> fictitious;
    std::size_t triangles;
  };
  const std::vector<Case> cases{{{0, 1}, {{0, 2}, {1, 1}, {2, 0}, {2, 2}}, 9},
                                {{1, 1}, {{0, 2}, {2, 0}, {2, 2}}, 8},
                                {{1, 2}, {{0, 2}, {1, 1}, {1, 3}, {2, 0}, {2, 2}, {2, 4}}, 13},
                                {{1, 3}, {{0, 2}, {2, 2}, {2, 4}}, 8},
                                {{2, 0}, {{2, 2}}, 5}};
  for (const Case& c : cases) {
    const Bitree tree = tree_of(2, {c.point});
    std::set<std::pair<int, int>> fictitious;
    for (int row = 0; row < 5; ++row) {
      for (int col = 0; col < 5; ++col) {
        if (tree.state[tree.index(row, col)] == BitreeState::kFictitious) fictitious.emplace(row, col);
      }
    }
    EXPECT_EQ(fictitious, c.fictitious) << c.point.first << "," << c.point.second;
    EXPECT_EQ(bitree_mesh(tree).triangle_count(), c.triangles) << c.point.first << "," << c.point.second;
  }
}

void expect_sound_mesh(const Bitree& tree) {
  const TinMesh mesh = bitree_mesh(tree);
  ASSERT_EQ(test::mesh_fault(mesh), "");
  ASSERT_EQ(mesh.vertices.size(), tree.selected + tree.fictitious);
  const TinBorder border = border_of(mesh);
  const std::size_t on_border = border.west.size() + border.east.size() + border.north.size() + border.south.size() - 4;
  ASSERT_EQ(mesh.triangle_count(), 2 * mesh.vertices.size() - 2 - on_border);
  for (std::size_t t = 1; t < mesh.triangle_count(); ++t) {   // Sierpinski order: neighbours in the list share an edge
    int shared = 0;
    for (std::size_t a = 0; a < 3; ++a) {
      for (std::size_t b = 0; b < 3; ++b) shared += mesh.triangles[3 * t + a] == mesh.triangles[3 * t - 3 + b] ? 1 : 0;
    }
    ASSERT_EQ(shared, 2) << t;
  }

  // The strip gives the same triangles with the same winding.
  const std::vector<std::uint32_t> strip = bitree_strip(mesh);
  std::vector<std::array<std::uint32_t, 3>> from_strip, from_list;
  const auto canonical = [](std::uint32_t a, std::uint32_t b, std::uint32_t c) {
    std::array<std::uint32_t, 3> t{a, b, c};
    std::rotate(t.begin(), std::min_element(t.begin(), t.end()), t.end());
    return t;
  };
  for (std::size_t k = 0; k + 2 < strip.size(); ++k) {
    const std::uint32_t a = strip[k + k % 2], b = strip[k + 1 - k % 2], c = strip[k + 2];
    if (a != b && b != c && a != c) from_strip.push_back(canonical(a, b, c));
  }
  for (std::size_t t = 0; t < mesh.triangle_count(); ++t) from_list.push_back(canonical(mesh.triangles[3 * t], mesh.triangles[3 * t + 1], mesh.triangles[3 * t + 2]));
  ASSERT_EQ(from_strip, from_list);
}

TEST(BitreeMesh, IsConformingForAnySelectionAndAnyPrefix) {
  std::mt19937 random(11);
  for (int n = 1; n <= 6; ++n) {
    for (int round = 0; round < 12; ++round) {
      std::vector<std::pair<int, int>> points;
      const int side = (1 << n) + 1;
      const auto count = static_cast<int>(random() % static_cast<unsigned>(side * side / 2 + 1));
      for (int k = 0; k < count; ++k) points.emplace_back(random() % static_cast<unsigned>(side), random() % static_cast<unsigned>(side));
      const Bitree tree = tree_of(n, points, &random);
      for (int level = 0; level <= 2 * n; ++level) ASSERT_NO_FATAL_FAILURE(expect_sound_mesh(bitree_prefix(tree, level))) << n << " " << round << " " << level;
    }
  }
}

TEST(BitreeMesh, TheFullTreeHasTheKnownStrip) {
  std::vector<std::pair<int, int>> all;
  for (int row = 0; row < 65; ++row) {
    for (int col = 0; col < 65; ++col) all.emplace_back(row, col);
  }
  const TinMesh mesh = bitree_mesh(tree_of(6, all));
  EXPECT_EQ(mesh.triangle_count(), 8192U);
  EXPECT_EQ(bitree_strip(mesh).size(), 13656U);
}

TEST(BitreeSurface, IsTheMeshAtEveryPost) {
  std::mt19937 random(5);
  for (int round = 0; round < 20; ++round) {
    std::vector<std::pair<int, int>> points;
    for (int k = 0; k < 60; ++k) points.emplace_back(random() % 33, random() % 33);
    const Bitree tree = tree_of(5, points, &random);
    const std::vector<double> surface = bitree_surface(tree);
    const std::vector<float> heights(surface.begin(), surface.end());
    EXPECT_LT(test::rasterised_error(bitree_mesh(tree), heights)[0], 1e-3);
  }
}

TEST(BitreeError, BoundHoldsAndIsTheErrorOfTheMesh) {
  for (const Kind kind : {Kind::kFloat, Kind::kInteger, Kind::kPlateau}) {
    const std::vector<float> heights = test::heights_of(kind, 7, 3, 129, 129, 0, 9);
    for (const double bound : {0.5, 3.0, 25.0}) {
      BitreeRequest request = request_for(heights, 129);
      request.max_error_m = bound;
      request.z_step_m = 0.25;
      const Bitree tree = built(request);
      const BitreeError error = measure_bitree_error(tree, request.field);
      EXPECT_LE(error.max_m, bound);
      const std::array<double, 2> rasterised = test::rasterised_error(bitree_mesh(tree), heights);
      EXPECT_NEAR(error.max_m, rasterised[0], 1e-3);
      EXPECT_NEAR(error.rms_m, rasterised[1], 1e-3);

      const std::vector<double> bounds = bitree_error_bounds(tree, error.max_m);
      ASSERT_EQ(bounds.size(), 15U);
      for (int level = 0; level <= 14; ++level) {
        const double prefix_error = measure_bitree_error(bitree_prefix(tree, level), request.field).max_m;
        EXPECT_LE(prefix_error, bounds[static_cast<std::size_t>(level)] * (1 + 1e-12));
        if (level > 0) {
          EXPECT_LE(bounds[static_cast<std::size_t>(level)], bounds[static_cast<std::size_t>(level) - 1]);
        }
      }
      EXPECT_EQ(bounds.back(), error.max_m);
    }
  }
}

TEST(BitreeEdges, NeighboursHaveTheSameEdgeSurface) {
  for (const Kind kind : {Kind::kFloat, Kind::kInteger, Kind::kPlateau}) {
    for (const bool is_bounded : {false, true}) {
      std::vector<std::vector<double>> surfaces;
      for (const int i0 : {0, 64}) {
        const std::vector<float> heights = test::heights_of(kind, i0, 5, 65, 65, 0, 21);
        BitreeRequest request = request_for(heights, 65);
        if (is_bounded) {
          request.max_error_m = 4;
        } else {
          request.threshold_m = 6;
        }
        surfaces.push_back(bitree_surface(built(request)));
      }
      for (std::size_t row = 0; row < 65; ++row) EXPECT_EQ(surfaces[0][row * 65 + 64], surfaces[1][row * 65]) << row;
    }
  }
}

TEST(BitreeQuadtree, HasRealHeightsAtEveryVertex) {
  const std::vector<float> heights = test::heights_of(Kind::kInteger, 0, 0, 65, 65, 0, 2);
  BitreeRequest request = request_for(heights, 65);
  request.max_error_m = 10;
  const Result<TinMesh> bitree = build_bitree_mesh(request), quadtree = build_bitree_mesh(request, 0, 0, true);
  ASSERT_TRUE(bitree && quadtree);
  EXPECT_EQ(bitree->triangles, quadtree->triangles);
  std::size_t off = 0;
  for (const TinVertex& v : quadtree->vertices) EXPECT_EQ(v.height_m, heights[static_cast<std::size_t>(v.row * 65 + v.col)]);
  for (const TinVertex& v : bitree->vertices) off += v.height_m != heights[static_cast<std::size_t>(v.row * 65 + v.col)] ? 1 : 0;
  EXPECT_GT(off, 0U);
  EXPECT_LE(bitree->max_error_m, 10);
}

TEST(BitreeSelection, KeepsEveryPostWhenAsked) {
  const std::vector<float> heights = test::heights_of(Kind::kInteger, 0, 0, 33, 33, 0, 8);
  BitreeRequest request = request_for(heights, 33);
  request.keeps_all = true;
  const Bitree tree = built(request);
  EXPECT_EQ(tree.selected, 33U * 33U);
  EXPECT_EQ(tree.fictitious, 0U);
  EXPECT_EQ(measure_bitree_error(tree, request.field).max_m, 0);
}

TEST(BitreeRequests, AreRefusedWithTheRuleTheyBreak) {
  std::vector<float> heights(81, 1);
  const auto code_of = [&](auto change) {
    BitreeRequest request = request_for(heights, 9);
    request.max_error_m = 1;
    change(request);
    Result<Bitree> tree = build_bitree(request);
    return tree ? std::string() : tree.error().message;
  };
  EXPECT_EQ(code_of([](BitreeRequest&) {}), "");
  EXPECT_NE(code_of([](BitreeRequest& r) { r.field.cols = r.field.rows = 8; }), "");
  EXPECT_NE(code_of([](BitreeRequest& r) { r.field.rows = 5; }), "");
  EXPECT_NE(code_of([](BitreeRequest& r) { r.max_error_m = -1; }), "");
  EXPECT_NE(code_of([](BitreeRequest& r) { r.threshold_m = std::nan(""); }), "");
  EXPECT_NE(code_of([](BitreeRequest& r) { r.max_error_m.reset(); }), "");
  EXPECT_NE(code_of([](BitreeRequest& r) { r.z_step_m = 0; }), "");
  EXPECT_NE(code_of([](BitreeRequest& r) { r.wavelet_levels = 0; }), "");
  EXPECT_NE(code_of([](BitreeRequest& r) { r.z_step_m = 1e-9; }), "");
  EXPECT_NE(code_of([](BitreeRequest& r) { r.z_step_m = 100, r.max_error_m = 0.5; }), "");
  std::vector<std::uint8_t> voids(81, 0);
  voids[40] = 1;
  EXPECT_NE(code_of([&](BitreeRequest& r) { r.field.is_void = voids; }), "");
  heights[40] = std::numeric_limits<float>::quiet_NaN();
  EXPECT_NE(code_of([](BitreeRequest&) {}).find("row 4, column 4"), std::string::npos);
}

}  // namespace
}  // namespace lodestone
