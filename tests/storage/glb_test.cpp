#include "storage/formats/glb.h"

#include <gtest/gtest.h>

#include <cmath>
#include <cstdlib>
#include <fstream>
#include <nlohmann/json.hpp>

#include "kernels/mesh/tin.h"
#include "tests/support/jacksboro.h"
#include "tests/support/mesh_check.h"
#include "tests/support/terrain.h"

namespace lodestone {
namespace {

std::span<const std::uint8_t> bytes_of(const std::string& s) {
  return {reinterpret_cast<const std::uint8_t*>(s.data()), s.size()};
}

struct Sample {
  std::vector<float> heights;
  TinMesh mesh;
};

// Jacksboro when posts fit into it, with one post of halo.
Sample sample(int posts, double error_m, bool has_zones, int transition, bool has_skirt, bool has_normals,
              int seed = 0) {
  Sample s;
  const test::SampleDem dem = test::jacksboro();
  EXPECT_GT(dem.cols, 0) << "python-matplotlib-data is not installed; run config/set-up";
  s.heights = dem.window(10 + 3 * seed, 5 + 2 * seed, posts, 1);
  std::vector<std::uint16_t> labels;
  for (int r = -6; r < posts + 5; ++r) {
    for (int c = -6; c < posts + 5; ++c)
      labels.push_back(static_cast<std::uint16_t>(
          std::fmod(std::abs(test::terrain_m(c, r, 3 + static_cast<unsigned>(seed), 2)) * 2, 4)));
  }
  TinRequest request;
  request.field = {s.heights, {}, posts, posts, 1};
  request.i0 = 10;
  request.j0 = 5;
  request.max_error_m = error_m;
  if (has_zones) request.zones = ZoneField{labels, 6, 0.75, 0.5, transition};
  Result<TinMesh> mesh = build_tin(request);
  EXPECT_TRUE(mesh) << mesh.error().message;
  s.mesh = std::move(*mesh);
  if (has_normals) set_normals(s.mesh, request.field, 75, 92);
  if (has_skirt) add_skirt(s.mesh, skirt_depth_m(s.mesh, error_m));
  return s;
}

TEST(Glb, GivesBackPositionsNormalsAndTriangles) {
  const Sample s = sample(129, 10, false, 0, true, true);
  GlbOptions options;
  options.frame = PlanarFrame{7500, 1840, 75, 92};
  options.extras["layer"] = "jacksboro \"quoted\"";
  const Result<std::string> glb = encode_glb(s.mesh, options);
  ASSERT_TRUE(glb) << glb.error().message;
  EXPECT_EQ(*glb, *encode_glb(s.mesh, options));
  const Result<DecodedGlb> back = decode_glb(bytes_of(*glb));
  ASSERT_TRUE(back) << back.error().message;
  ASSERT_EQ(back->primitives.size(), 1U);
  const GlbPrimitive& p = back->primitives[0];
  EXPECT_EQ(p.indices, s.mesh.triangles);
  ASSERT_EQ(p.positions.size(), 3 * s.mesh.vertex_count());
  for (std::size_t v = 0; v < s.mesh.vertex_count(); ++v) {
    const TinVertex& at = s.mesh.vertices[v];
    EXPECT_EQ(back->translation[0] + p.positions[3 * v], 7500 + 75.0 * at.col);
    EXPECT_NEAR(back->translation[1] + p.positions[3 * v + 1], at.height_m, 1e-4);
    EXPECT_EQ(back->translation[2] + p.positions[3 * v + 2], 1840 + 92.0 * at.row);
    EXPECT_EQ(p.normals[3 * v + 1], s.mesh.normals[3 * v + 2]);
    EXPECT_FLOAT_EQ(p.uvs[2 * v], static_cast<float>(at.col / 128.0));
    EXPECT_FLOAT_EQ(p.uvs[2 * v + 1], static_cast<float>(at.row / 128.0));
  }
  const auto json = nlohmann::json::parse(back->json);
  const auto& extras = json["meshes"][0]["extras"];
  EXPECT_EQ(extras["maxErrorM"].get<double>(), s.mesh.max_error_m);
  EXPECT_LE(extras["maxErrorM"].get<double>(), 10.0);
  EXPECT_EQ(extras["topTriangles"].get<std::size_t>(), s.mesh.top_triangles);
  EXPECT_EQ(extras["skirtDepthM"].get<float>(), s.mesh.skirt_depth_m);
  EXPECT_EQ(extras["layer"], "jacksboro \"quoted\"");
  // Seen from above, glTF's y, triangles are counter-clockwise.
  for (std::size_t t = 0; t < s.mesh.top_triangles; ++t) {
    const float* a = &p.positions[3 * p.indices[3 * t]];
    const float* b = &p.positions[3 * p.indices[3 * t + 1]];
    const float* c = &p.positions[3 * p.indices[3 * t + 2]];
    EXPECT_GT((b[2] - a[2]) * (c[0] - a[0]) - (b[0] - a[0]) * (c[2] - a[2]), 0);
  }
}

TEST(Glb, WritesOnePrimitiveAndMaterialPerZone) {
  const Sample s = sample(129, 15, true, 2, true, true);
  GlbOptions options;
  options.zone_names[1] = "forest";
  const Result<std::string> glb = encode_glb(s.mesh, options);
  ASSERT_TRUE(glb) << glb.error().message;
  const Result<DecodedGlb> back = decode_glb(bytes_of(*glb));
  ASSERT_TRUE(back) << back.error().message;
  std::map<int, std::size_t> expected, found;
  for (const std::uint16_t zone : s.mesh.zones) ++expected[zone];
  const auto json = nlohmann::json::parse(back->json);
  bool has_blend = false;
  for (std::size_t k = 0; k < back->primitives.size(); ++k) {
    const GlbPrimitive& p = back->primitives[k];
    found[p.zone] = p.indices.size() / 3;
    const auto material =
        json["materials"][json["meshes"][0]["primitives"][k]["material"].get<std::size_t>()]["name"]
            .get<std::string>();
    if (p.zone == 1) {
      EXPECT_EQ(material, "forest");
    } else if (!is_transition(static_cast<std::uint16_t>(p.zone))) {
      EXPECT_EQ(material, "zone " + std::to_string(p.zone));
    } else {
      has_blend = true;
      ASSERT_EQ(p.blend.size(), p.positions.size() / 3);
      EXPECT_LT(*std::min_element(p.blend.begin(), p.blend.end()),
                *std::max_element(p.blend.begin(), p.blend.end()));
    }
  }
  EXPECT_EQ(found, expected);
  EXPECT_TRUE(has_blend);
}

TEST(Glb, TexturesOfNeighboursDifferByWholeRepeats) {
  const std::vector<float> flat(9 * 9, 5);
  const TinMesh mesh = *build_grid_mesh({flat, {}, 9, 9, 0}, 0, 0, 1);
  GlbOptions west, east;
  west.texture_size_m = east.texture_size_m = 70;
  west.frame = PlanarFrame{800, 0, 100, 100};
  east.frame = PlanarFrame{1600, 0, 100, 100};
  const Result<DecodedGlb> a = decode_glb(bytes_of(*encode_glb(mesh, west))),
                           b = decode_glb(bytes_of(*encode_glb(mesh, east)));
  const float at_east = a->primitives[0].uvs[2 * 8], at_west = b->primitives[0].uvs[0];
  EXPECT_NEAR(std::remainder(at_east - at_west, 1.0), 0, 1e-5);
  EXPECT_GE(at_west, 0);
  EXPECT_LT(at_west, 1);
}

TEST(Glb, QuantisedHeightsStayWithinHalfAStepAndSayIt) {
  const Sample s = sample(129, 10, false, 0, false, true);
  GlbOptions options;
  options.frame = PlanarFrame{0, 0, 75, 92};
  options.is_quantized = true;
  const Result<std::string> glb = encode_glb(s.mesh, options);
  ASSERT_TRUE(glb);
  EXPECT_LT(glb->size(), encode_glb(s.mesh, GlbOptions{})->size() * 0.8);
  const Result<DecodedGlb> back = decode_glb(bytes_of(*glb));
  ASSERT_TRUE(back) << back.error().message;
  TinMesh decoded = s.mesh;
  for (std::size_t v = 0; v < decoded.vertex_count(); ++v) {
    const float* p = &back->primitives[0].positions[3 * v];
    EXPECT_EQ(p[0], decoded.vertices[v].col);
    EXPECT_EQ(p[2], decoded.vertices[v].row);
    decoded.vertices[v].height_m = static_cast<float>(back->translation[1] + back->scale[1] * p[1]);
  }
  const double told = nlohmann::json::parse(back->json)["meshes"][0]["extras"]["maxErrorM"];
  const double true_error = measure_error(decoded, {s.heights, {}, 129, 129, 1}).max_m;
  EXPECT_LE(true_error, told + 1e-4);
  EXPECT_GT(told, s.mesh.max_error_m);
}

TEST(Glb, StandsOnTheEllipsoidAsThreeDTilesWants) {
  const std::vector<float> flat(3 * 3, 100);
  TinMesh mesh = *build_grid_mesh({flat, {}, 3, 3, 0}, 0, 0, 1);
  set_normals(mesh, {flat, {}, 3, 3, 0}, 1, 1);
  GlbOptions options;
  options.frame = GeodeticFrame{-1, -1, 1, 1, false};
  const Result<DecodedGlb> back = decode_glb(bytes_of(*encode_glb(mesh, options)));
  ASSERT_TRUE(back);
  // glTF (x, y, z) becomes (x, -z, y) in 3D Tiles.
  EXPECT_NEAR(back->translation[0], 6378237, 1e-6);
  EXPECT_NEAR(back->translation[1], 0, 1e-6);
  EXPECT_NEAR(back->translation[2], 0, 1e-6);
  const GlbPrimitive& p = back->primitives[0];
  EXPECT_NEAR(p.normals[3 * 4], 1, 1e-6);  // the middle post looks along ECEF x
  EXPECT_GT(p.positions[1], 110000);       // north-west post: north is glTF y
  EXPECT_GT(p.positions[2], 110000);       // and west is glTF +z (ECEF -y)
  EXPECT_NEAR(ecef_from_geodetic(90, 0, 0)[1], 6378137, 1e-6);
  EXPECT_NEAR(ecef_from_geodetic(0, 90, 0)[2], 6356752.314245, 1e-5);
}

TEST(Glb, UsesWideIndicesOnlyWhereItMust) {
  const std::vector<float> heights = test::heights_of(test::Kind::kFloat, 0, 0, 257, 257, 0, 1);
  const TinMesh mesh = *build_grid_mesh({heights, {}, 257, 257, 0}, 0, 0, 1);
  ASSERT_GT(mesh.vertex_count(), 65536U);
  const Result<DecodedGlb> back = decode_glb(bytes_of(*encode_glb(mesh, GlbOptions{})));
  ASSERT_TRUE(back);
  EXPECT_EQ(back->primitives[0].indices, mesh.triangles);
  EXPECT_NE(back->json.find("\"componentType\":5125"), std::string::npos);
  const TinMesh small = *build_grid_mesh({heights, {}, 257, 257, 0}, 0, 0, 2);
  EXPECT_EQ(decode_glb(bytes_of(*encode_glb(small, GlbOptions{})))->json.find("\"componentType\":5125"),
            std::string::npos);
}

TEST(Glb, RefusesMeshesAndOptionsThatItCannotWrite) {
  EXPECT_FALSE(encode_glb(TinMesh{}, {}));
  const std::vector<float> flat(9, 1);
  const TinMesh mesh = *build_grid_mesh({flat, {}, 3, 3, 0}, 0, 0, 1);
  GlbOptions options;
  options.texture_size_m = 0;
  EXPECT_FALSE(encode_glb(mesh, options));
  options = {};
  options.is_quantized = true;
  options.frame = GeodeticFrame{0, 0, 1, 1, false};
  EXPECT_FALSE(encode_glb(mesh, options));
}

TEST(Glb, DecoderSurvivesEveryPrefixAndManyWrongBytes) {
  const std::vector<float> heights = test::heights_of(test::Kind::kFloat, 0, 0, 9, 9, 0, 1);
  TinMesh mesh = *build_grid_mesh({heights, {}, 9, 9, 0}, 0, 0, 4);
  set_normals(mesh, {heights, {}, 9, 9, 0}, 1, 1);
  const std::string glb = *encode_glb(mesh, GlbOptions{});
  for (std::size_t n = 0; n < glb.size(); ++n) {
    const std::vector<std::uint8_t> prefix(glb.begin(), glb.begin() + static_cast<std::ptrdiff_t>(n));
    EXPECT_FALSE(decode_glb(prefix)) << n;
  }
  std::vector<std::uint8_t> longer(glb.begin(), glb.end());
  longer.push_back(0);
  EXPECT_FALSE(decode_glb(longer));
  for (std::size_t at = 0; at < glb.size(); ++at) {
    for (const int flip : {1, 16, 255}) {
      std::vector<std::uint8_t> bad(glb.begin(), glb.end());
      bad[at] = static_cast<std::uint8_t>(bad[at] ^ flip);
      const Result<DecodedGlb> result = decode_glb(bad, 1 << 20);
      if (result) {
        for (const GlbPrimitive& p : result->primitives) {
          for (const std::uint32_t i : p.indices) ASSERT_LT(i, p.positions.size() / 3);
        }
      }
    }
  }
  EXPECT_FALSE(decode_glb(bytes_of(glb), 64)) << "the limit holds";
}

// Files for the clients in tests/clients: every option set, several windows. Always checked to decode; kept
// when a folder is given.
TEST(Glb, EveryOptionSetDecodes) {
  const char* folder = std::getenv("LODESTONE_GLB_OUT");
  const double bounds[] = {2, 8, 20, 60};
  int files = 0;
  for (int seed = 0; seed < 4; ++seed) {
    for (int set = 0; set < 24; ++set) {
      const bool has_zones = set & 1, has_skirt = set & 2, has_normals = set & 4;
      const int shape = set / 8;  // floats on a plane, quantised, ellipsoid
      const Sample s = sample(65 + 64 * (seed % 2), bounds[seed], has_zones, has_zones ? seed % 3 : 0,
                              has_skirt, has_normals, seed * 24 + set);
      GlbOptions options;
      if (shape < 2) options.frame = PlanarFrame{1000.5 * seed, 77.25 * set, 75, 92};
      if (shape == 2) options.frame = GeodeticFrame{-84.4, 36.6, -84.3, 36.7, (set & 1) != 0};
      options.is_quantized = shape == 1;
      if (seed == 3 && shape == 0) options.texture_size_m = 256;
      const Result<std::string> glb = encode_glb(s.mesh, options);
      ASSERT_TRUE(glb) << glb.error().message;
      ASSERT_TRUE(decode_glb(bytes_of(*glb)));
      ++files;
      if (folder == nullptr) continue;
      std::ofstream(std::string(folder) + "/" + std::to_string(seed) + "_" + std::to_string(set) + ".glb",
                    std::ios::binary)
          << *glb;
    }
  }
  EXPECT_EQ(files, 96);
}

}  // namespace
}  // namespace lodestone
