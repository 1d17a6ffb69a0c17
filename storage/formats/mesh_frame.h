#pragma once
// Where a tile's posts lie: from (col, row, height) to metres on a plane, to degrees, to Earth-centred
// metres.

#include <array>
#include <cstdint>
#include <vector>

#include "kernels/types/tin_mesh.h"

namespace lodestone {

using Vec3 = std::array<double, 3>;

// A plane: metres east and south of the layer's north-west post.
struct PlanarFrame {
  double west_m = 0, north_m = 0;           // of the mesh's north-west post, east and south of the layer's
  double spacing_x_m = 1, spacing_y_m = 1;  // between posts, > 0
};

// A rectangle of the WGS84 ellipsoid, degrees; heights are metres above the ellipsoid. Posts are even in
// longitude, and in latitude or (is_mercator) in spherical Mercator northing.
struct GeodeticFrame {
  double west_deg = 0, south_deg = 0, east_deg = 0, north_deg = 0;
  bool is_mercator = false;
};

// Latitude of a row, 0 = north edge, 1 = south edge.
double latitude_deg(const GeodeticFrame& frame, double row_share);
// Earth-centred, Earth-fixed metres.
Vec3 ecef_from_geodetic(double lon_deg, double lat_deg, double height_m);
// ECEF direction of a (east, north, up) vector at that place.
Vec3 ecef_from_enu(double lon_deg, double lat_deg, const Vec3& enu);
// ECEF position of every vertex.
std::vector<Vec3> ecef_positions(const TinMesh& mesh, const GeodeticFrame& frame);

// Positions and normals ready for glTF (y up): local to `translation`.
struct PlacedMesh {
  Vec3 translation{};
  std::vector<float> positions;  // 3 per vertex
  std::vector<float> normals;    // 3 per vertex, or empty
};
// x east, y up, z south; origin in the middle of the mesh at a whole metre of height.
PlacedMesh placed_on_plane(const TinMesh& mesh, const PlanarFrame& frame);
// Earth-centred axes turned to glTF's: (X, Z, -Y), as 3D Tiles expects.
PlacedMesh placed_on_ellipsoid(const TinMesh& mesh, const GeodeticFrame& frame);

}  // namespace lodestone
