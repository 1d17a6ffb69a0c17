#pragma once
// CrsTransform: points between WGS84 longitude/latitude and a layer's CRS, through PROJ.

#include <memory>
#include <span>
#include <string>

#include "kernels/types/result.h"

namespace lodestone {

// Thread-safe (one call at a time inside). x is east or longitude, y north or latitude, whatever order the CRS states.
class CrsTransform {
 public:
  // Error: kInvalidArgument (the WKT is not a CRS, or PROJ knows no way to WGS84).
  static Result<std::shared_ptr<CrsTransform>> create(const std::string& layer_wkt);
  virtual ~CrsTransform() = default;
  // In place. ok[n] = false where a point has no counterpart.
  virtual void layer_from_wgs84(std::span<double> x, std::span<double> y, std::span<bool> ok) = 0;
  virtual void wgs84_from_layer(std::span<double> x, std::span<double> y, std::span<bool> ok) = 0;
};

}  // namespace lodestone
