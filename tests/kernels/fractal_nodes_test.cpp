// Roughness of nodes, level of detail, quadtree simplification and flora.

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <random>

#include "kernels/fractal/flora.h"
#include "kernels/fractal/level_of_detail.h"
#include "kernels/fractal/node_roughness.h"
#include "kernels/fractal/quadtree.h"

namespace lodestone {
namespace {

TEST(PredictorRatio, AgreesWithTheTable) {
  const double h[] = {0.1, 0.3, 0.5, 0.7, 0.9};
  const double centre[] = {.940637, .998297, 1.058924, 1.122699, 1.189837};
  const double edge[] = {.908595, .899715, .890446, .880852, .871011};
  const double square[] = {.956874, .951443, .954603, .966143, .985781};
  for (int n = 0; n < 5; ++n) {
    EXPECT_NEAR(predictor_ratio(h[n], NodeKind::kDiamondCentre), centre[n], 1e-6);
    EXPECT_NEAR(predictor_ratio(h[n], NodeKind::kDiamondEdge), edge[n], 1e-6);
    EXPECT_NEAR(predictor_ratio(h[n], NodeKind::kSquare), square[n], 1e-6);
  }
  EXPECT_EQ(predictor_ratio(1.5, NodeKind::kSquare), predictor_ratio(0.95, NodeKind::kSquare));
  EXPECT_EQ(predictor_ratio(0.3, NodeKind::kWaveletCentre), 1);
}

TEST(NodeDeviation, FallsByHPerIteration) {
  const NodeRoughness node{3, 0.5F};
  EXPECT_NEAR(node_deviation(node, 2, NodeKind::kWaveletEdge), 3 * std::exp2(-1.0), 1e-6);
  EXPECT_NEAR(node_deviation(node, 2, NodeKind::kWaveletCentre), 3 * std::exp2(-0.75), 1e-6);
  EXPECT_NEAR(node_deviation(node, 4, NodeKind::kSquare), 3 * 0.25 * .954603, 1e-5);
  EXPECT_EQ(node_deviation({0, 0.5F}, 1, NodeKind::kSquare), 0);
}

HeightGrid grid_of(PostWindow w, auto height) {
  HeightGrid g{w, {}, {}};
  for (std::int64_t j = w.j0; j <= w.j1; ++j)
    for (std::int64_t i = w.i0; i <= w.i1; ++i) g.heights_m.push_back(static_cast<float>(height(i, j)));
  return g;
}

TEST(EstimateNodes, SeesNothingInPlanesAndHasADefault) {
  const PostWindow w{3, 5, 3 + 40, 5 + 33};
  const NodeCrop crop =
      estimate_nodes(grid_of(w, [](auto i, auto j) { return 2.0 * i - 3.0 * j; }), w, layer_nodes(w, 4), 4);
  EXPECT_EQ(crop.width, 3);
  EXPECT_EQ(crop.height, 3);
  for (const NodeRoughness& n : crop.nodes) EXPECT_EQ(n, (NodeRoughness{0, 0.8F}));
}

TEST(EstimateNodes, FindsTheHurstExponentOfAKnownProcess) {
  // The sum of one random walk per axis: E r(tau)^2 = s^2 tau / 2, so H = 1/2 and sigma = s / sqrt 2.
  const PostWindow w{0, 0, 512, 512};
  std::mt19937 rng(5);
  std::normal_distribution<double> step(0, 2);
  double h = 0, log_sigma = 0;
  int count = 0;
  for (int run = 0; run < 8; ++run) {
    std::vector<double> x(513, 0), y(513, 0);
    for (std::size_t n = 1; n < 513; ++n) {
      x[n] = x[n - 1] + step(rng);
      y[n] = y[n - 1] + step(rng);
    }
    const HeightGrid g = grid_of(
        w, [&](auto i, auto j) { return x[static_cast<std::size_t>(i)] + y[static_cast<std::size_t>(j)]; });
    for (const NodeRoughness& n : estimate_nodes(g, w, layer_nodes(w, 6), 6).nodes) {
      h += static_cast<double>(n.h);
      log_sigma += std::log2(static_cast<double>(n.sigma_m));
      ++count;
    }
  }
  EXPECT_NEAR(h / count, 0.5, 0.06);
  EXPECT_NEAR(log_sigma / count, std::log2(2 / std::sqrt(2.0)), 0.1);
}

TEST(EstimateNodes, DependsOnTheWorldNotOnTheRectangle) {
  const PostWindow w{0, 0, 70, 50};
  std::mt19937 rng(6);
  const HeightGrid g = grid_of(w, [&](auto, auto) { return rng() % 1000; });
  const NodeCrop all = estimate_nodes(g, w, layer_nodes(w, 3), 3);
  for (std::int64_t b = 0; b < all.height; b += 2)
    for (std::int64_t a = 0; a < all.width; a += 3) {
      const PostWindow one{a, b, a, b};
      const PostWindow reads = node_heights_window(one, w, 3);
      const HeightGrid crop = grid_of(reads, [&](auto i, auto j) { return g.at(i, j); });
      EXPECT_EQ(estimate_nodes(crop, w, one, 3).nodes[0],
                all.nodes[static_cast<std::size_t>(b * all.width + a)]);
    }
}

TEST(EstimateNodes, LeavesVoidsOut) {
  const PostWindow w{0, 0, 16, 16};
  std::mt19937 rng(6);
  HeightGrid g = grid_of(w, [&](auto, auto) { return rng() % 10; });
  const NodeRoughness before = estimate_nodes(g, w, {0, 0, 0, 0}, 4).nodes[0];
  g.is_void.assign(g.heights_m.size(), 0);
  g.heights_m[g.index(8, 8)] = 1e6F;
  g.is_void[g.index(8, 8)] = 1;
  EXPECT_NEAR(estimate_nodes(g, w, {0, 0, 0, 0}, 4).nodes[0].sigma_m, before.sigma_m, 0.3);
  std::fill(g.is_void.begin(), g.is_void.end(), 1);
  EXPECT_EQ(estimate_nodes(g, w, {0, 0, 0, 0}, 4).nodes[0], (NodeRoughness{0, 0.8F}));
}

TEST(LevelOfDetail, AgreesWithTheWorkedExample) {
  const ProjectionRule rule{std::acos(-1.0) / 3, 1024, 2};
  EXPECT_NEAR(distance_threshold_m(90, rule), 39906.4506, 1e-3);
  EXPECT_EQ(fractal_iterations(90, 100, 16, rule), 9);
  EXPECT_EQ(fractal_iterations(90, 1000, 16, rule), 6);
  EXPECT_EQ(fractal_iterations(90, 10000, 16, rule), 2);
  EXPECT_EQ(fractal_iterations(90, 39906, 16, rule), 1);
  EXPECT_EQ(fractal_iterations(90, 39907, 16, rule), 0);
  EXPECT_EQ(fractal_iterations(90, 0, 16, rule), 16);
  EXPECT_EQ(fractal_iterations(90, 1e-6, 16, rule), 16);
  for (double d = 50; d < 1e5; d *= 1.1) {
    const int n = fractal_iterations(90, d, 16, rule);
    EXPECT_LE(projected_px(90 / std::exp2(n), d, rule), 2 * (1 + 1e-12)) << d;
    if (n > 0) {
      EXPECT_GT(projected_px(90 / std::exp2(n - 1), d, rule), 2) << d;
    }
  }
}

TEST(LevelOfDetail, SharedEdgeIsThePolylineOfTheCoarserPatch) {
  const std::vector<float> coarse{0, 8, 4};
  EXPECT_EQ(shared_edge(coarse, 0), coarse);
  EXPECT_EQ(shared_edge(coarse, 2), (std::vector<float>{0, 2, 4, 6, 8, 7, 6, 5, 4}));
}

TEST(Triangles, SplitAsPrinted) {
  constexpr Diagonal kFalling = Diagonal::kNorthWestSouthEast, kRising = Diagonal::kNorthEastSouthWest;
  EXPECT_EQ(lowest_diagonal(1, 5, 6, 2), kFalling);
  EXPECT_EQ(lowest_diagonal(5, 1, 2, 6), kRising);
  EXPECT_EQ(shorter_diagonal(5, 1, 2, 6), kFalling);
  EXPECT_EQ(lowest_diagonal(0, 1, 9, 3), kFalling);
  EXPECT_EQ(lowest_diagonal(1, 1, 2, 8), kRising);
  EXPECT_EQ(lowest_diagonal(4, 4, 4, 4), kFalling);
}

TEST(Triangles, FaceTheViewerAboveThem) {
  const Vector3 a{0, 0, 0}, b{1, 0, 0}, c{0, 1, 0};
  EXPECT_EQ(triangle_normal(a, b, c), (Vector3{0, 0, 1}));
  EXPECT_TRUE(is_facing(a, b, c, {5, 5, 1}));
  EXPECT_FALSE(is_facing(a, b, c, {5, 5, -1}));
  EXPECT_FALSE(is_facing(a, b, c, {5, 5, 0}));
}

std::vector<float> hills(int posts) {
  std::vector<float> h;
  for (int j = 0; j < posts; ++j)
    for (int i = 0; i < posts; ++i)
      h.push_back(static_cast<float>(100 * std::sin(i * 0.07) * std::cos(j * 0.05) +
                                     ((i * 7919 + j * 104729) % 97) * 0.02 * (i > posts / 2)));
  return h;
}

// Every inner edge belongs to two triangles with opposite directions, border edges to one, and the areas fill
// the square.
void expect_watertight(const QuadtreeMesh& mesh, int posts) {
  std::map<std::pair<std::uint32_t, std::uint32_t>, int> edges;
  const auto x = [&](std::uint32_t v) { return static_cast<double>(v % static_cast<unsigned>(posts)); };
  const auto y = [&](std::uint32_t v) { return -static_cast<double>(v / static_cast<unsigned>(posts)); };
  double area = 0;
  for (std::size_t n = 0; n < mesh.triangles.size(); n += 3) {
    const std::uint32_t v[3] = {mesh.triangles[n], mesh.triangles[n + 1], mesh.triangles[n + 2]};
    const double twice =
        (x(v[1]) - x(v[0])) * (y(v[2]) - y(v[0])) - (x(v[2]) - x(v[0])) * (y(v[1]) - y(v[0]));
    ASSERT_GT(twice, 0);
    area += twice / 2;
    for (int k = 0; k < 3; ++k) ++edges[{v[k], v[(k + 1) % 3]}];
  }
  EXPECT_EQ(area, (posts - 1.0) * (posts - 1.0));
  const auto on_border = [&](std::uint32_t a, std::uint32_t b) {
    const double far = posts - 1;
    return (x(a) == x(b) && (x(a) == 0 || x(a) == far)) || (y(a) == y(b) && (y(a) == 0 || y(a) == -far));
  };
  for (const auto& [edge, count] : edges) {
    ASSERT_EQ(count, 1);
    ASSERT_EQ(edges.count({edge.second, edge.first}), on_border(edge.first, edge.second) ? 0u : 1u);
  }
}

TEST(Quadtree, RemovesTheShareAskedFor) {
  const std::vector<float> h = hills(129);
  for (const double percent : {0.0, 10.0, 48.76, 75.0, 99.0, 100.0}) {
    const Result<QuadtreeMesh> mesh = simplify_quadtree(h, 129, {-1, percent, false});
    ASSERT_TRUE(mesh) << mesh.error().message;
    EXPECT_NEAR(mesh->removed_percent, percent, 150.0 / (128 * 128) + (percent == 100 ? 0.01 : 0)) << percent;
    EXPECT_EQ(static_cast<std::int64_t>(mesh->leaves.size()), 128 * 128 - 3 * mesh->collapsed);
    expect_watertight(*mesh, 129);
  }
}

TEST(Quadtree, KeepsTheToleranceAndTheBorder) {
  const std::vector<float> h = hills(65);
  std::size_t before = ~std::size_t{0};
  for (const double tolerance : {0.0, 0.1, 1.0, 10.0}) {
    const Result<QuadtreeMesh> mesh = simplify_quadtree(h, 65, {tolerance, 0, true});
    ASSERT_TRUE(mesh);
    EXPECT_LE(mesh->max_error_m, tolerance);
    EXPECT_LE(mesh->leaves.size(), before);
    before = mesh->leaves.size();
    expect_watertight(*mesh, 65);
    for (const QuadtreeLeaf& leaf : mesh->leaves) {
      for (int b = 0; b <= leaf.size; ++b)
        for (int a = 0; a <= leaf.size; ++a) {
          const auto at = [&](int i, int j) {
            return static_cast<double>(h[static_cast<std::size_t>(j * 65 + i)]);
          };
          const double u = static_cast<double>(a) / leaf.size, v = static_cast<double>(b) / leaf.size;
          const double north = at(leaf.x, leaf.y) * (1 - u) + at(leaf.x + leaf.size, leaf.y) * u;
          const double south =
              at(leaf.x, leaf.y + leaf.size) * (1 - u) + at(leaf.x + leaf.size, leaf.y + leaf.size) * u;
          ASSERT_LE(std::abs(at(leaf.x + a, leaf.y + b) - (north * (1 - v) + south * v)), tolerance + 1e-9);
        }
    }
    std::vector<bool> used(65 * 65, false);
    for (const std::uint32_t v : mesh->triangles) used[v] = true;
    for (std::size_t n = 0; n < 65; ++n)
      EXPECT_TRUE(used[n] && used[64 * 65 + n] && used[n * 65] && used[n * 65 + 64]);
  }
}

TEST(Quadtree, BreaksTiesOnAPlateauByMortonIndex) {
  const Result<QuadtreeMesh> mesh =
      simplify_quadtree(std::vector<float>(81, 5.0F), 9, {-1, 300.0 * 3 / 64, false});
  ASSERT_TRUE(mesh);
  EXPECT_EQ(mesh->collapsed, 3);
  const std::vector<QuadtreeLeaf> first(mesh->leaves.begin(), mesh->leaves.begin() + 4);
  EXPECT_EQ(first, (std::vector<QuadtreeLeaf>{{0, 0, 2}, {2, 0, 2}, {0, 2, 2}, {2, 2, 1}}));
}

TEST(Quadtree, RefusesOtherSizes) {
  EXPECT_FALSE(simplify_quadtree(std::vector<float>(36, 0), 6, {}));
  EXPECT_FALSE(simplify_quadtree(std::vector<float>(24, 0), 5, {}));
  EXPECT_FALSE(simplify_quadtree(std::vector<float>(25, 0), 5, {-1, 101}));
  EXPECT_FALSE(simplify_quadtree(std::vector<float>(25, NAN), 5, {}));
}

TEST(Flora, FollowsItsRulesInOrder) {
  const FloraRules rules{10.0F, 2000, 3000};
  EXPECT_EQ(classify_flora(9, 5, 1, rules), FloraClass::kWater);
  EXPECT_EQ(classify_flora(12, 0.05F, 1, rules), FloraClass::kSand);
  EXPECT_EQ(classify_flora(12, 0.5F, 1, rules), FloraClass::kForest);
  EXPECT_EQ(classify_flora(3500, 0.5F, 1, rules), FloraClass::kSnow);
  EXPECT_EQ(classify_flora(3500, 1.5F, 1, rules), FloraClass::kRock);
  EXPECT_EQ(classify_flora(2500, 0.2F, 1, rules), FloraClass::kRock);
  EXPECT_EQ(classify_flora(100, 0.2F, 0.5F, rules), FloraClass::kForest);
  EXPECT_EQ(classify_flora(100, 0.2F, 0.2F, rules), FloraClass::kGrass);
  EXPECT_EQ(classify_flora(100, 0.2F, 0.1F, rules), FloraClass::kBare);
  EXPECT_EQ(classify_flora(-5, 0, 0.1F, {}), FloraClass::kBare);  // no water level set
}

TEST(Flora, ColoursAGridFromSlopeAndCurvature) {
  std::vector<float> h;
  for (int j = 0; j < 5; ++j)
    for (int i = 0; i < 5; ++i) h.push_back(100.0F + 20.0F * static_cast<float>(i));  // slope 2 at 10 m posts
  for (const FloraClass c : flora_of_grid(h, {}, 3, 3, 10, 10, {})) EXPECT_EQ(c, FloraClass::kRock);
  std::fill(h.begin(), h.end(), 100.0F);
  for (const FloraClass c : flora_of_grid(h, {}, 3, 3, 10, 10, {})) EXPECT_EQ(c, FloraClass::kForest);
  h[12] = 104;  // a knoll is drier
  EXPECT_EQ(flora_of_grid(h, {}, 3, 3, 10, 10, {})[4], FloraClass::kBare);
  EXPECT_EQ(flora_of_grid(h, std::vector<float>(9, 0.3F), 3, 3, 10, 10, {})[4], FloraClass::kGrass);
}

}  // namespace
}  // namespace lodestone
