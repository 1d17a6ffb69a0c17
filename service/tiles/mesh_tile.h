#pragma once
// Mesh tiles: their options, and GLB or quantized-mesh bytes from a tile's heights.

#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <string_view>

#include "kernels/types/result.h"
#include "kernels/types/tile_id.h"
#include "service/ground/layer.h"

namespace lodestone {

struct TileKey;

enum class MeshKind : std::uint8_t { kTin, kGrid };

// Extensions of quantized-mesh that a client asked for.
enum TerrainExtension : std::uint8_t { kTerrainNormals = 1, kTerrainWatermask = 2, kTerrainMetadata = 4 };

struct MeshOptions {
  MeshKind kind = MeshKind::kTin;
  std::optional<double> error_m;           // none: the level's default, or only the budget's
  std::optional<std::uint64_t> triangles;  // at most so many top triangles
  double skirt_m = 0;                      // 0 none, < 0 as deep as the measured error needs
  bool is_quantized = false;               // KHR_mesh_quantization
  bool is_earth_centred = false;           // ECEF positions; else metres on the layer's plane
  std::uint8_t extensions = 0;             // TerrainExtension bits
  bool is_gzip = false;                    // the stored bytes are a gzip member
  bool is_flat = false;                    // a root tile without data, at the ellipsoid

  std::string text() const;  // canonical, for the tile's key
};

// One option of .glb: mesh, error, triangles, skirt, positions, frame; of .terrain: error, triangles. False: no such option.
bool is_mesh_option(bool is_terrain, std::string_view name);
// Error: kInvalidArgument (names key, value and what is allowed).
Result<void> set_mesh_option(MeshOptions& options, const std::string& name, const std::string& value);
// What only shows when all options are known. Error: kInvalidArgument.
Result<void> check_mesh_options(const TileKey& key);

// Bits of TerrainExtension in "application/vnd.quantized-mesh;extensions=octvertexnormals-watermask, ...".
std::uint8_t terrain_extensions(std::string_view accept);

// 77067.34 m / 2^z on WorldCRS84Quad (what CesiumJS takes for granted), else half a post spacing of the level.
double default_mesh_error_m(const LayerInfo& info, int z);

struct MeshTile {
  std::string body;
  double max_error_m = 0;  // measured over every post, encoding included
};
// with_halo_m: (n + 2)^2 heights, row 0 north, one post beyond the tile on every side. provenance_bits goes into the
// metadata. Errors: those of build_tin and the encoders.
Result<MeshTile> make_mesh_tile(const TileKey& key, std::span<const float> with_halo_m, std::uint8_t provenance_bits);
// A root tile where the layer has no data.
Result<MeshTile> make_flat_tile(const TileKey& key);

}  // namespace lodestone
