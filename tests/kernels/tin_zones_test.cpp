#include <gtest/gtest.h>

#include <cmath>
#include <map>
#include <random>
#include <sstream>

#include "kernels/mesh/tin.h"
#include "kernels/mesh/zone_border.h"
#include "tests/support/mesh_check.h"
#include "tests/support/terrain.h"

namespace lodestone {
namespace {

using test::Kind;

// "1122/1122": one digit per cell.
CellLabels drawn(const std::string& text) {
  CellLabels map;
  std::istringstream in(text);
  for (std::string row; std::getline(in, row, '/');) {
    map.cols = static_cast<std::int32_t>(row.size());
    ++map.rows;
    for (const char c : row) map.labels.push_back(static_cast<std::uint16_t>(c - '0'));
  }
  return map;
}

std::vector<LatticePoint> rc(std::initializer_list<std::pair<int, int>> row_col) {
  std::vector<LatticePoint> points;
  for (const auto& [r, c] : row_col) points.push_back({c, r});
  return points;
}

// Zones of a smooth random field, by global cell: an endless map.
std::uint16_t zone_at(std::int64_t i, std::int64_t j, std::uint64_t seed) {
  return static_cast<std::uint16_t>(
      std::clamp(std::floor(test::terrain_m(i, j, seed, 2) / 1.2) + 3, 0.0, 6.0));
}
std::vector<std::uint16_t> zone_cells(std::int64_t i0, std::int64_t j0, int cells, int halo,
                                      std::uint64_t seed) {
  std::vector<std::uint16_t> labels;
  for (int r = -halo; r < cells + halo; ++r) {
    for (int c = -halo; c < cells + halo; ++c) labels.push_back(zone_at(i0 + c, j0 + r, seed));
  }
  return labels;
}

TEST(ZoneBorder, TracesThePaperStyleExample) {
  const CellLabels map = drawn("1122/1122/3332/3333");
  const std::vector<ZoneChain> chains = simplify_zone_borders(trace_zone_borders(map), 4, 4, 0, 0xffff);
  ASSERT_EQ(chains.size(), 3U);
  EXPECT_EQ(chains[0].points, rc({{0, 2}, {2, 2}}));
  EXPECT_EQ(chains[0].left, 2);
  EXPECT_EQ(chains[0].right, 1);
  EXPECT_EQ(chains[1].points, rc({{2, 0}, {2, 2}}));
  EXPECT_EQ(chains[1].left, 1);
  EXPECT_EQ(chains[1].right, 3);
  EXPECT_EQ(chains[2].points, rc({{2, 2}, {2, 3}, {3, 3}, {3, 4}}));
  EXPECT_EQ(chains[2].left, 2);
  EXPECT_EQ(chains[2].right, 3);
  const auto inner = [](std::vector<std::uint8_t> flags) {
    std::vector<int> at;
    for (std::size_t k = 1; k + 1 < flags.size(); ++k) {
      if (flags[k]) at.push_back(static_cast<int>(k));
    }
    return at;
  };
  EXPECT_EQ(inner(required_edge_posts(map, false, 0)), std::vector<int>{2});
  EXPECT_EQ(inner(required_edge_posts(map, true, 0)), std::vector<int>{2});
  EXPECT_EQ(inner(required_edge_posts(map, true, 4)), std::vector<int>{3});
  EXPECT_TRUE(inner(required_edge_posts(map, false, 4)).empty());
}

TEST(ZoneBorder, MarksTransitionsWithBothZones) {
  const CellLabels marked = with_transitions(drawn("1122/1122/3332/3333"), 1);
  constexpr std::uint16_t a = 0x8082, b = 0x8083, c = 0x8103;
  EXPECT_EQ(marked.labels, (std::vector<std::uint16_t>{1, a, a, 2, b, a, a, c, b, b, c, c, 3, 3, c, c}));
  EXPECT_EQ(first_zone(c), 2);
  EXPECT_EQ(second_zone(c), 3);
  EXPECT_EQ(transition_zone(3, 2), c);
}

TEST(ZoneBorder, StraightensADiagonalStair) {
  CellLabels map;
  map.cols = map.rows = 8;
  for (int r = 0; r < 8; ++r) {
    for (int c = 0; c < 8; ++c) map.labels.push_back(r + c >= 8);
  }
  const std::vector<ZoneChain> unit = trace_zone_borders(map);
  ASSERT_EQ(unit.size(), 1U);
  EXPECT_EQ(unit[0].points.size(), 15U);
  EXPECT_EQ(simplify_zone_borders(unit, 8, 8, 0, 0xffff)[0].points.size(), 15U);
  EXPECT_EQ(simplify_zone_borders(unit, 8, 8, 0.75, 0xffff)[0].points, rc({{1, 8}, {8, 1}}));
}

TEST(ZoneBorder, LoopsStartAtTheirFirstPostAndDoNotCollapse) {
  const CellLabels map = drawn("00000/01110/01110/01110/00000");
  const std::vector<ZoneChain> unit = trace_zone_borders(map);
  ASSERT_EQ(unit.size(), 1U);
  EXPECT_EQ(unit[0].points.front(), (LatticePoint{1, 1}));
  EXPECT_EQ(unit[0].points.back(), (LatticePoint{1, 1}));
  const auto loop = simplify_zone_borders(unit, 5, 5, 50, 0xffff)[0].points;
  EXPECT_GE(loop.size(), 4U) << "a loop keeps an area";
}

TEST(ZoneBorder, SieveJoinsSmallRegionsToTheLongestContact) {
  CellLabels map = drawn("11111/12231/13331/11111");
  sieve_zones(map, 3);
  EXPECT_EQ(map.labels, drawn("11111/11131/13331/11111").labels);
  sieve_zones(map, 5);
  EXPECT_EQ(map.labels, drawn("11111/11111/11111/11111").labels);
}

TEST(ZoneBorder, DroppedVerticesStayNearAndSegmentsStayLegal) {
  for (std::uint64_t seed = 1; seed < 12; ++seed) {
    CellLabels map;
    map.cols = map.rows = 64;
    map.labels = zone_cells(0, 0, 64, 0, seed);
    const std::vector<ZoneChain> unit = trace_zone_borders(map);
    for (const double epsilon : {0.75, 3.0, 12.0}) {
      const std::vector<ZoneChain> chains = simplify_zone_borders(unit, 64, 64, epsilon, 0xffff);
      ASSERT_EQ(chains.size(), unit.size());
      std::size_t kept = 0, all = 0;
      for (std::size_t k = 0; k < chains.size(); ++k) {
        kept += chains[k].points.size();
        all += unit[k].points.size();
        std::size_t at = 0;
        for (const LatticePoint& p : unit[k].points) {
          if (at + 2 < chains[k].points.size() && p == chains[k].points[at + 1]) ++at;
          const LatticePoint a = chains[k].points[at], b = chains[k].points[at + 1];
          const double dx = b.col - a.col, dy = b.row - a.row;
          const double s =
              std::clamp(((p.col - a.col) * dx + (p.row - a.row) * dy) / (dx * dx + dy * dy), 0.0, 1.0);
          ASSERT_LT(std::hypot(p.col - a.col - s * dx, p.row - a.row - s * dy), epsilon);
        }
      }
      EXPECT_LT(kept, all);
    }
  }
}

struct ZoneCase {
  Kind kind;
  double epsilon, tie;
  int transition;
};
class ZonedTin : public testing::TestWithParam<ZoneCase> {};

TEST_P(ZonedTin, IsAProperMeshWhoseZonesFollowTheMap) {
  const ZoneCase p = GetParam();
  constexpr int kPosts = 65;
  for (std::uint64_t seed = 1; seed <= 6; ++seed) {
    const std::vector<float> heights = test::heights_of(p.kind, 0, 0, kPosts, kPosts, 0, seed);
    const int halo = p.transition + 1;
    const std::vector<std::uint16_t> labels = zone_cells(0, 0, kPosts - 1, halo, seed);
    TinRequest request;
    request.field = {heights, {}, kPosts, kPosts, 0};
    request.max_error_m = 12;
    request.zones = ZoneField{labels, halo, p.epsilon, p.tie, p.transition};
    const Result<TinMesh> result = build_tin(request);
    ASSERT_TRUE(result) << result.error().message;
    const TinMesh& mesh = *result;
    ASSERT_EQ(test::mesh_fault(mesh), "");
    EXPECT_LE(test::rasterised_error(mesh, heights)[0], 12 + 1e-9);
    ASSERT_EQ(mesh.zones.size(), mesh.triangle_count());

    CellLabels map;
    map.cols = map.rows = kPosts - 1;
    map.halo = halo;
    map.labels = labels;
    if (p.transition > 0) map = with_transitions(map, p.transition);
    // The cell under a triangle's centroid has its zone, or lies within epsilon + tie of a border.
    const double reach = p.epsilon + (p.epsilon > 0 ? p.tie : p.tie) + 1e-9;
    for (std::size_t t = 0; t < mesh.top_triangles; ++t) {
      double x = 0, y = 0;
      for (std::size_t i = 0; i < 3; ++i) {
        x += mesh.vertices[mesh.triangles[3 * t + i]].col / 3.0;
        y += mesh.vertices[mesh.triangles[3 * t + i]].row / 3.0;
      }
      bool is_near = false;
      for (int r = static_cast<int>(y - reach - 1); r <= static_cast<int>(y + reach + 1) && !is_near; ++r) {
        for (int c = static_cast<int>(x - reach - 1); c <= static_cast<int>(x + reach + 1) && !is_near; ++c) {
          if (c < 0 || r < 0 || c >= kPosts - 1 || r >= kPosts - 1 || map.at(c, r) != mesh.zones[t]) continue;
          const double dx = std::max({c - x, x - c - 1, 0.0}), dy = std::max({r - y, y - r - 1, 0.0});
          is_near = std::hypot(dx, dy) <= reach;
        }
      }
      ASSERT_TRUE(is_near) << "triangle " << t << " zone " << mesh.zones[t] << " at " << x << "," << y
                           << " seed " << seed;
    }
    // Every junction and every place where a border leaves the tile is a vertex.
    std::set<std::pair<int, int>> posts;
    for (const TinVertex& v : mesh.vertices) posts.emplace(v.col, v.row);
    for (const ZoneChain& chain : trace_zone_borders(map)) {
      EXPECT_TRUE(posts.count({chain.points.front().col, chain.points.front().row}));
      EXPECT_TRUE(posts.count({chain.points.back().col, chain.points.back().row}));
    }
    if (p.epsilon == 0 && p.tie == 0) {
      // Exact borders: the area of every zone is that of its cells.
      std::map<int, std::int64_t> area;
      for (std::size_t t = 0; t < mesh.top_triangles; ++t) area[mesh.zones[t]] += test::area2_of(mesh, t);
      for (int r = 0; r + 1 < kPosts; ++r) {
        for (int c = 0; c + 1 < kPosts; ++c) area[map.at(c, r)] -= 2;
      }
      for (const auto& [zone, left] : area) EXPECT_EQ(left, 0) << zone;
    }
    if (p.transition > 0) {
      ASSERT_EQ(mesh.blend.size(), mesh.triangles.size());
      for (const float w : mesh.blend) EXPECT_TRUE(w >= 0 && w <= 1);
    }
  }
}
INSTANTIATE_TEST_SUITE_P(Cases, ZonedTin,
                         testing::Values(ZoneCase{Kind::kFloat, 0, 0, 0},
                                         ZoneCase{Kind::kFloat, 0.75, 0.5, 0},
                                         ZoneCase{Kind::kInteger, 0.75, 0.5, 0},
                                         ZoneCase{Kind::kPlateau, 2, 0.9, 0},
                                         ZoneCase{Kind::kInteger, 5, 1.5, 0}, ZoneCase{Kind::kFloat, 0, 0, 2},
                                         ZoneCase{Kind::kInteger, 0.75, 0.5, 1}));

TEST(ZonedTin, BordersAgreeBetweenNeighbours) {
  constexpr int kPosts = 33;
  for (int pair = 0; pair < 120; ++pair) {
    const std::int64_t i0 = pair * 64, j0 = pair * 96;
    const double bounds[] = {0, 0.5, 3, 10, 60};
    const int transition = pair % 3;
    const auto mesh_at = [&](std::int64_t i, std::int64_t j) {
      const std::vector<float> heights =
          test::heights_of(pair % 2 ? Kind::kInteger : Kind::kFloat, i, j, kPosts, kPosts, 0, 5);
      const std::vector<std::uint16_t> labels = zone_cells(i, j, kPosts - 1, 3 * transition + 3, 5);
      TinRequest request;
      request.field = {heights, {}, kPosts, kPosts, 0};
      request.i0 = i;
      request.j0 = j;
      request.max_error_m = bounds[pair % 5];
      request.zones = ZoneField{labels, 3 * transition + 3, 0.75 + pair % 4, 0.5, transition};
      Result<TinMesh> mesh = build_tin(request);
      EXPECT_TRUE(mesh);
      EXPECT_EQ(test::mesh_fault(*mesh), "");
      return std::move(*mesh);
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

TEST(ZonedTin, SurvivesNoiseInTheZoneMap) {
  constexpr int kPosts = 33;
  for (std::uint64_t seed = 0; seed < 12; ++seed) {
    const std::vector<float> heights = test::heights_of(Kind::kInteger, 0, 0, kPosts, kPosts, 0, seed);
    std::vector<std::uint16_t> labels;
    for (int k = 0; k < 34 * 34; ++k)
      labels.push_back(
          static_cast<std::uint16_t>(test::hash01(k, 0, seed) * static_cast<double>(2 + seed % 5)));
    for (const double epsilon : {0.0, 0.75, 4.0}) {
      TinRequest request;
      request.field = {heights, {}, kPosts, kPosts, 0};
      request.max_error_m = 20;
      request.zones = ZoneField{labels, 1, epsilon, 0.9, seed % 2 ? 0 : 1};
      const Result<TinMesh> mesh = build_tin(request);
      ASSERT_TRUE(mesh);
      EXPECT_EQ(test::mesh_fault(*mesh), "") << seed << ' ' << epsilon;
      EXPECT_LE(mesh->max_error_m, 20);
    }
  }
}

TEST(ZonedTin, OneZoneChangesNothingAndRelabellingPermutesOnlyTheIds) {
  constexpr int kPosts = 65;
  const std::vector<float> heights = test::heights_of(Kind::kInteger, 0, 0, kPosts, kPosts, 0, 3);
  TinRequest request;
  request.field = {heights, {}, kPosts, kPosts, 0};
  request.max_error_m = 9;
  const Result<TinMesh> plain = build_tin(request);
  const std::vector<std::uint16_t> one(66 * 66, 5);
  request.zones = ZoneField{one, 1};
  const Result<TinMesh> single = build_tin(request);
  ASSERT_TRUE(plain && single);
  EXPECT_EQ(plain->vertices, single->vertices);
  EXPECT_EQ(plain->triangles, single->triangles);
  std::vector<std::uint16_t> labels = zone_cells(0, 0, kPosts - 1, 1, 3), renamed = labels;
  for (std::uint16_t& z : renamed) z = static_cast<std::uint16_t>(100 - 7 * z);
  request.zones = ZoneField{labels, 1};
  const Result<TinMesh> a = build_tin(request);
  request.zones = ZoneField{renamed, 1};
  const Result<TinMesh> b = build_tin(request);
  ASSERT_TRUE(a && b);
  EXPECT_EQ(a->vertices, b->vertices);
  EXPECT_EQ(a->triangles, b->triangles);
  for (std::size_t t = 0; t < a->zones.size(); ++t) EXPECT_EQ(b->zones[t], 100 - 7 * a->zones[t]);
  std::set<std::uint16_t> seen(a->zones.begin(), a->zones.end());
  EXPECT_GT(seen.size(), 1U);
}

TEST(ZonedTin, ZonesEqualAFloodFillOverTheFinishedMesh) {
  constexpr int kPosts = 65;
  for (std::uint64_t seed = 1; seed < 8; ++seed) {
    const std::vector<float> heights = test::heights_of(Kind::kFloat, 0, 0, kPosts, kPosts, 0, seed);
    const std::vector<std::uint16_t> labels = zone_cells(0, 0, kPosts - 1, 1, seed);
    TinRequest request;
    request.field = {heights, {}, kPosts, kPosts, 0};
    request.max_error_m = 4;
    request.zones = ZoneField{labels, 1, 2, 1.2};
    const Result<TinMesh> mesh = build_tin(request);
    ASSERT_TRUE(mesh);
    // Regions joined through edges with one zone on both sides: as many as the 4-connected regions of the
    // map, zone by zone.
    std::map<std::pair<std::uint32_t, std::uint32_t>, std::size_t> owner;
    for (std::size_t k = 0; k < mesh->triangles.size(); ++k)
      owner[{mesh->triangles[k], mesh->triangles[k % 3 == 2 ? k - 2 : k + 1]}] = k / 3;
    const auto count_regions = [](std::size_t n, auto&& neighbours, auto&& zone) {
      std::vector<std::uint8_t> seen(n, 0);
      std::map<int, int> regions;
      for (std::size_t i = 0; i < n; ++i) {
        if (seen[i]) continue;
        ++regions[zone(i)];
        std::vector<std::size_t> stack{i};
        seen[i] = 1;
        while (!stack.empty()) {
          const std::size_t x = stack.back();
          stack.pop_back();
          for (const std::size_t y : neighbours(x)) {
            if (seen[y] || zone(y) != zone(x)) continue;
            seen[y] = 1;
            stack.push_back(y);
          }
        }
      }
      return regions;
    };
    const auto of_mesh = count_regions(
        mesh->triangle_count(),
        [&](std::size_t t) {
          std::vector<std::size_t> n;
          for (std::size_t i = 0; i < 3; ++i) {
            const auto it = owner.find({mesh->triangles[3 * t + (i + 1) % 3], mesh->triangles[3 * t + i]});
            if (it != owner.end()) n.push_back(it->second);
          }
          return n;
        },
        [&](std::size_t t) { return static_cast<int>(mesh->zones[t]); });
    const auto of_map = count_regions(
        64 * 64,
        [](std::size_t i) {
          std::vector<std::size_t> n;
          if (i % 64 > 0) n.push_back(i - 1);
          if (i % 64 < 63) n.push_back(i + 1);
          if (i >= 64) n.push_back(i - 64);
          if (i + 64 < 64 * 64) n.push_back(i + 64);
          return n;
        },
        [&](std::size_t i) { return static_cast<int>(labels[(i / 64 + 1) * 66 + i % 64 + 1]); });
    EXPECT_EQ(of_mesh, of_map) << seed;
  }
}

}  // namespace
}  // namespace lodestone
