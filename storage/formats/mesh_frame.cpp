#include "storage/formats/mesh_frame.h"

#include <cmath>
#include <numbers>

namespace lodestone {
namespace {

constexpr double kRadius_m = 6378137.0;
constexpr double kFlattening = 1 / 298.257223563;
constexpr double kEccentricity2 = kFlattening * (2 - kFlattening);

double radians(double deg) { return deg * std::numbers::pi / 180; }
double mercator(double lat_deg) { return std::asinh(std::tan(radians(lat_deg))); }

// Lowest and highest vertex, rounded to the middle in whole metres: keeps float32 heights exact to the
// millimetre.
double base_height_m(const TinMesh& mesh) {
  if (mesh.top_vertices == 0) return 0;
  const auto [low, high] = height_range(mesh);
  return std::floor((static_cast<double>(low) + high) / 2);
}

}  // namespace

double latitude_deg(const GeodeticFrame& frame, double row_share) {
  if (!frame.is_mercator) return frame.north_deg + (frame.south_deg - frame.north_deg) * row_share;
  if (row_share <= 0) return frame.north_deg;
  if (row_share >= 1) return frame.south_deg;
  const double north = mercator(frame.north_deg), south = mercator(frame.south_deg);
  return std::atan(std::sinh(north + (south - north) * row_share)) * 180 / std::numbers::pi;
}

Vec3 ecef_from_geodetic(double lon_deg, double lat_deg, double height_m) {
  const double lon = radians(lon_deg), lat = radians(lat_deg);
  const double n = kRadius_m / std::sqrt(1 - kEccentricity2 * std::sin(lat) * std::sin(lat));
  return {(n + height_m) * std::cos(lat) * std::cos(lon), (n + height_m) * std::cos(lat) * std::sin(lon),
          (n * (1 - kEccentricity2) + height_m) * std::sin(lat)};
}

Vec3 ecef_from_enu(double lon_deg, double lat_deg, const Vec3& enu) {
  const double lon = radians(lon_deg), lat = radians(lat_deg);
  const double sl = std::sin(lon), cl = std::cos(lon), sp = std::sin(lat), cp = std::cos(lat);
  return {-sl * enu[0] - sp * cl * enu[1] + cp * cl * enu[2],
          cl * enu[0] - sp * sl * enu[1] + cp * sl * enu[2], cp * enu[1] + sp * enu[2]};
}

std::vector<Vec3> ecef_positions(const TinMesh& mesh, const GeodeticFrame& frame) {
  std::vector<Vec3> positions;
  positions.reserve(mesh.vertices.size());
  for (const TinVertex& v : mesh.vertices) {
    const double lon = frame.west_deg + (frame.east_deg - frame.west_deg) * v.col / (mesh.cols - 1);
    positions.push_back(ecef_from_geodetic(
        lon, latitude_deg(frame, static_cast<double>(v.row) / (mesh.rows - 1)), v.height_m));
  }
  return positions;
}

PlacedMesh placed_on_plane(const TinMesh& mesh, const PlanarFrame& frame) {
  PlacedMesh placed;
  const double mid_col = (mesh.cols - 1) / 2.0, mid_row = (mesh.rows - 1) / 2.0, base = base_height_m(mesh);
  placed.translation = {frame.west_m + mid_col * frame.spacing_x_m, base,
                        frame.north_m + mid_row * frame.spacing_y_m};
  placed.positions.reserve(3 * mesh.vertices.size());
  for (const TinVertex& v : mesh.vertices) {
    placed.positions.push_back(static_cast<float>((v.col - mid_col) * frame.spacing_x_m));
    placed.positions.push_back(static_cast<float>(v.height_m - base));
    placed.positions.push_back(static_cast<float>((v.row - mid_row) * frame.spacing_y_m));
  }
  placed.normals.reserve(mesh.normals.size());
  for (std::size_t i = 0; i + 2 < mesh.normals.size(); i += 3) {
    placed.normals.insert(placed.normals.end(), {mesh.normals[i], mesh.normals[i + 2], -mesh.normals[i + 1]});
  }
  return placed;
}

PlacedMesh placed_on_ellipsoid(const TinMesh& mesh, const GeodeticFrame& frame) {
  PlacedMesh placed;
  const double mid_lon = (frame.west_deg + frame.east_deg) / 2;
  const Vec3 origin = ecef_from_geodetic(mid_lon, latitude_deg(frame, 0.5), base_height_m(mesh));
  placed.translation = {origin[0], origin[2], -origin[1]};
  for (const Vec3& p : ecef_positions(mesh, frame)) {
    placed.positions.push_back(static_cast<float>(p[0] - origin[0]));
    placed.positions.push_back(static_cast<float>(p[2] - origin[2]));
    placed.positions.push_back(static_cast<float>(-(p[1] - origin[1])));
  }
  for (std::size_t v = 0; 3 * v + 2 < mesh.normals.size(); ++v) {
    const TinVertex& at = mesh.vertices[v];
    const double lon = frame.west_deg + (frame.east_deg - frame.west_deg) * at.col / (mesh.cols - 1);
    const double lat = latitude_deg(frame, static_cast<double>(at.row) / (mesh.rows - 1));
    const Vec3 n =
        ecef_from_enu(lon, lat, {mesh.normals[3 * v], mesh.normals[3 * v + 1], mesh.normals[3 * v + 2]});
    const double length = std::sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
    placed.normals.insert(placed.normals.end(),
                          {static_cast<float>(n[0] / length), static_cast<float>(n[2] / length),
                           static_cast<float>(-n[1] / length)});
  }
  return placed;
}

}  // namespace lodestone
