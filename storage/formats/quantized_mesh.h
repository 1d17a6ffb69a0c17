#pragma once
// quantized-mesh 1.0 terrain tiles (Cesium), with the octvertexnormals, watermask and metadata extensions,
// and a strict reader. Bytes are a pure function of the arguments.

#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "kernels/types/result.h"
#include "kernels/types/tin_mesh.h"
#include "storage/formats/mesh_frame.h"

namespace lodestone {

struct QuantizedMeshOptions {
  GeodeticFrame frame;
  bool has_normals = false;  // extension 1; needs mesh.normals
  std::optional<std::span<const std::uint8_t>>
      watermask;              // extension 2; 1 byte or 256 * 256 from the north-west, 0 land, 255 water
  std::string metadata_json;  // extension 4 when not empty
};

// The top surface only: clients make their own skirts. Errors: kInvalidArgument (no triangles, watermask of a
// wrong size, normals asked for and absent).
Result<std::string> encode_quantized_mesh(const TinMesh& mesh, const QuantizedMeshOptions& options);

// How much farther than mesh.max_error_m the decoded surface may be from the posts: half a height step, and
// the steepest triangle times the rounding of columns and rows. Ask for a bound smaller by this where the
// bound must hold after encoding.
double quantized_mesh_slack_m(const TinMesh& mesh, const GeodeticFrame& frame);

struct DecodedQuantizedMesh {
  Vec3 centre{}, sphere_centre{}, horizon_occlusion{};  // the last in ellipsoid-scaled space
  double sphere_radius = 0;
  float height_min_m = 0, height_max_m = 0;
  std::vector<std::uint16_t> u, v, height;  // 0..32767; u from the west, v from the south
  std::vector<std::uint32_t> indices;
  std::vector<std::uint32_t> west, south, east, north;
  std::vector<std::uint8_t> oct_normals;  // 2 per vertex, or empty
  std::vector<std::uint8_t> watermask;    // 1 or 65536 bytes, or empty
  std::string metadata_json;

  double height_m(std::size_t i) const {
    return height_min_m + (static_cast<double>(height_max_m) - height_min_m) * height[i] / 32767;
  }
};
// Errors: kCorrupt, kTooLarge (over max_vertices or four times as many triangles). Unknown extensions are
// skipped.
Result<DecodedQuantizedMesh> decode_quantized_mesh(std::span<const std::uint8_t> bytes,
                                                   std::size_t max_vertices = std::size_t{1} << 22);

// Two bytes of the octahedral encoding of a unit vector, and back.
std::array<std::uint8_t, 2> oct_encoded(const Vec3& unit);
Vec3 oct_decoded(std::uint8_t x, std::uint8_t y);

}  // namespace lodestone
