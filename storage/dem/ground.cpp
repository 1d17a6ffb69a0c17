#include "storage/dem/ground.h"

#include <ogr_spatialref.h>

#include <algorithm>
#include <cmath>
#include <memory>
#include <numbers>
#include <vector>

namespace lodestone {
namespace {

constexpr int kStepsPerEdge = 32;
constexpr double kSemiMajorM = 6378137.0;  // WGS84
constexpr double kEccentricity2 = 0.00669437999014;

// Metres between two near points, longitude and latitude in degrees: radii of curvature at the mean latitude.
double ground_distance_m(double lon0, double lat0, double lon1, double lat1) {
  const double rad = std::numbers::pi / 180;
  const double s = std::sin((lat0 + lat1) / 2 * rad);
  const double w = 1 - kEccentricity2 * s * s;
  const double north = kSemiMajorM * (1 - kEccentricity2) / (w * std::sqrt(w));
  const double east = kSemiMajorM / std::sqrt(w);
  const double dlon = std::remainder(lon1 - lon0, 360.0) * rad;
  const double dlat = (lat1 - lat0) * rad;
  return std::hypot(dlon * east * std::sqrt(std::max(0.0, 1 - s * s)), dlat * north);
}

}  // namespace

std::string crs_display_name(const OGRSpatialReference& crs) {
  const char* authority = crs.GetAuthorityName(nullptr);
  const char* code = crs.GetAuthorityCode(nullptr);
  if (authority != nullptr && code != nullptr) return std::string(authority) + ":" + code;
  const char* name = crs.GetName();
  return name != nullptr ? name : "unnamed";
}

std::string vertical_datum_of(const OGRSpatialReference& crs) {
  if (!crs.IsCompound() && !crs.IsVertical()) return {};
  const char* name = crs.GetAttrValue("VERT_CS");
  return name != nullptr ? name : "";
}

Result<void> locate(LayerInfo& info) {
  OGRSpatialReference crs;
  OGRSpatialReference wgs84;
  wgs84.SetWellKnownGeogCS("WGS84");
  if (crs.SetFromUserInput(info.crs_wkt.c_str()) != OGRERR_NONE) {
    return Error{
        ErrorCode::kUnsupported,
        "layer " + info.name +
            ": its coordinate reference system cannot be read; assign one with gdal_translate -a_srs"};
  }
  crs.SetAxisMappingStrategy(OAMS_TRADITIONAL_GIS_ORDER);
  wgs84.SetAxisMappingStrategy(OAMS_TRADITIONAL_GIS_ORDER);
  const std::unique_ptr<OGRCoordinateTransformation> to_wgs84(
      OGRCreateCoordinateTransformation(&crs, &wgs84));
  const Error no_way{ErrorCode::kUnsupported,
                     "layer " + info.name + ": no transformation from " + info.crs_name +
                         " to WGS84; assign the right system with gdal_translate -a_srs"};
  if (!to_wgs84) return no_way;

  // The rectangle of posts, corner to corner, walked clockwise from the north-west.
  const PostWindow& w = info.world;
  std::vector<std::array<double, 2>> ring;
  const auto walk = [&](double i0, double j0, double i1, double j1) {
    for (int s = 0; s < kStepsPerEdge; ++s) {
      const double f = static_cast<double>(s) / kStepsPerEdge;
      ring.push_back(info.world_from_post(info.base_level, i0 + f * (i1 - i0), j0 + f * (j1 - j0)));
    }
  };
  const auto i0 = static_cast<double>(w.i0), j0 = static_cast<double>(w.j0);
  const auto i1 = static_cast<double>(w.i1), j1 = static_cast<double>(w.j1);
  walk(i0, j0, i1, j0);
  walk(i1, j0, i1, j1);
  walk(i1, j1, i0, j1);
  walk(i0, j1, i0, j0);
  info.bounds = {ring[0][0], ring[0][1], ring[0][0], ring[0][1]};
  for (const auto& p : ring) {
    info.bounds = {std::min(info.bounds[0], p[0]), std::min(info.bounds[1], p[1]),
                   std::max(info.bounds[2], p[0]), std::max(info.bounds[3], p[1])};
  }

  // Longitudes are unwrapped along the ring, so that a layer across the date line gets west > east and not
  // the whole globe.
  double west = 0, east = 0, south = 90, north = -90, before = 0;
  const bool is_geographic = crs.IsGeographic() != 0;
  for (std::size_t k = 0; k < ring.size(); ++k) {
    double lon = ring[k][0], lat = ring[k][1];
    if (!to_wgs84->Transform(1, &lon, &lat) || !std::isfinite(lon) || !std::isfinite(lat)) return no_way;
    if (k > 0 && !is_geographic) lon = before + std::remainder(lon - before, 360.0);
    west = k == 0 ? lon : std::min(west, lon);
    east = k == 0 ? lon : std::max(east, lon);
    south = std::min(south, lat);
    north = std::max(north, lat);
    before = lon;
  }
  if (east - west >= 360) {
    west = -180;
    east = 180;
  } else if (west < -180 || west >= 180) {
    const double shift = std::floor((west + 180) / 360) * 360;
    west -= shift;
    east -= shift;
  }
  if (east > 180) east -= 360;
  info.bounds_wgs84 = {west, std::max(south, -90.0), east, std::min(north, 90.0)};

  // A cell at the centre. A single post has no cell; its step still has a length.
  const double ci = (i0 + i1) / 2, cj = (j0 + j1) / 2;
  std::array<std::array<double, 2>, 3> p = {info.world_from_post(info.base_level, ci, cj),
                                            info.world_from_post(info.base_level, ci + 1, cj),
                                            info.world_from_post(info.base_level, ci, cj + 1)};
  for (auto& q : p) {
    if (!to_wgs84->Transform(1, &q[0], &q[1])) return no_way;
  }
  info.cell_x_m = ground_distance_m(p[0][0], p[0][1], p[1][0], p[1][1]);
  info.cell_y_m = ground_distance_m(p[0][0], p[0][1], p[2][0], p[2][1]);
  if (!std::isfinite(info.cell_x_m) || !std::isfinite(info.cell_y_m)) return no_way;
  return {};
}

}  // namespace lodestone
