#pragma once
// Where a layer lies on the Earth: bounds, their WGS84 box and the size of a cell, from its CRS and post
// transform.

#include <string>

#include "storage/dem/layer_info.h"

class OGRSpatialReference;

namespace lodestone {

// "EPSG:4326" where the CRS has a code, else its name.
std::string crs_display_name(const OGRSpatialReference& crs);
// Name of the vertical CRS of a compound CRS; empty if there is none.
std::string vertical_datum_of(const OGRSpatialReference& crs);
// Fills bounds, bounds_wgs84, cell_x_m, cell_y_m from crs_wkt, transform and world. Error: kUnsupported (CRS
// without a way to WGS84).
Result<void> locate(LayerInfo& info);

}  // namespace lodestone
