#pragma once
// GLB (binary glTF 2.0) of a terrain mesh, and a strict reader of what we write. Bytes are a pure function of
// the arguments.

#include <cstdint>
#include <map>
#include <optional>
#include <span>
#include <string>
#include <variant>
#include <vector>

#include "kernels/types/result.h"
#include "kernels/types/tin_mesh.h"
#include "storage/formats/mesh_frame.h"

namespace lodestone {

struct GlbOptions {
  std::variant<PlanarFrame, GeodeticFrame> frame = PlanarFrame{};
  std::string name = "terrain";
  // Size of one texture repeat in metres for TEXCOORD_0 on a plane (neighbours then differ by whole repeats);
  // without it the texture coordinates run 0..1 over the tile, (0, 0) in the north-west.
  std::optional<double> texture_size_m;
  std::map<std::uint16_t, std::string> zone_names;  // material names; "zone N" or "zones A-B" otherwise
  std::map<std::string, std::string> extras;        // more strings for the mesh's extras
  // KHR_mesh_quantization (planar frames): 16-bit positions, columns and rows exact, heights to range /
  // 65535; 8-bit normals.
  bool is_quantized = false;
};

// One TRIANGLES primitive, or one per zone (ascending) with extras.zone and, on transitions, extras.zones and
// the vertex attribute _BLEND. mesh.extras: maxErrorM (quantisation included), rmsErrorM, skirtDepthM, posts,
// origin (global post of the north-west corner); without zones also topVertices and topTriangles, where the
// skirt begins. Errors: kInvalidArgument for a mesh without triangles or with more vertices than uint32
// indices reach.
Result<std::string> encode_glb(const TinMesh& mesh, const GlbOptions& options);

struct GlbPrimitive {
  std::vector<float> positions, normals, uvs,
      blend;  // 3, 3, 2, 1 per vertex; dequantised, before the node's transform
  std::vector<std::uint32_t> indices;
  int zone = -1;
};
struct DecodedGlb {
  std::string json;
  Vec3 translation{}, scale{1, 1, 1};
  std::vector<GlbPrimitive> primitives;
};
// Errors: kCorrupt, kUnsupported, kTooLarge (over max_bytes in all).
Result<DecodedGlb> decode_glb(std::span<const std::uint8_t> bytes,
                              std::size_t max_bytes = std::size_t{1} << 30);

}  // namespace lodestone
