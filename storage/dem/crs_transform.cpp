#include "storage/dem/crs_transform.h"

#include <ogr_spatialref.h>

#include <mutex>
#include <vector>

namespace lodestone {
namespace {

struct TransformDeleter {
  void operator()(OGRCoordinateTransformation* t) const { OGRCoordinateTransformation::DestroyCT(t); }
};
using TransformPtr = std::unique_ptr<OGRCoordinateTransformation, TransformDeleter>;

class ProjTransform final : public CrsTransform {
 public:
  ProjTransform(TransformPtr to_layer, TransformPtr to_wgs84)
      : to_layer_(std::move(to_layer)), to_wgs84_(std::move(to_wgs84)) {}

  void layer_from_wgs84(std::span<double> x, std::span<double> y, std::span<bool> ok) override {
    run(*to_layer_, x, y, ok);
  }
  void wgs84_from_layer(std::span<double> x, std::span<double> y, std::span<bool> ok) override {
    run(*to_wgs84_, x, y, ok);
  }

 private:
  void run(OGRCoordinateTransformation& transform, std::span<double> x, std::span<double> y,
           std::span<bool> ok) {
    std::vector<int> good(x.size(), 0);
    {
      const std::lock_guard lock(mutex_);
      transform.Transform(static_cast<int>(x.size()), x.data(), y.data(), nullptr, good.data());
    }
    for (std::size_t n = 0; n < ok.size(); ++n) ok[n] = good[n] != 0;
  }

  std::mutex mutex_;  // guards both: PROJ objects serve one thread at a time
  TransformPtr to_layer_, to_wgs84_;
};

}  // namespace

Result<std::shared_ptr<CrsTransform>> CrsTransform::create(const std::string& layer_wkt) {
  OGRSpatialReference layer;
  OGRSpatialReference wgs84;
  if (layer.importFromWkt(layer_wkt.c_str()) != OGRERR_NONE) {
    return Error{ErrorCode::kInvalidArgument, "the layer's CRS is not valid WKT: " + layer_wkt.substr(0, 80)};
  }
  wgs84.importFromEPSG(4326);
  layer.SetAxisMappingStrategy(OAMS_TRADITIONAL_GIS_ORDER);
  wgs84.SetAxisMappingStrategy(OAMS_TRADITIONAL_GIS_ORDER);
  TransformPtr to_layer(OGRCreateCoordinateTransformation(&wgs84, &layer));
  TransformPtr to_wgs84(OGRCreateCoordinateTransformation(&layer, &wgs84));
  if (!to_layer || !to_wgs84) {
    return Error{ErrorCode::kInvalidArgument,
                 "PROJ knows no transformation between WGS84 and the layer's CRS"};
  }
  return std::shared_ptr<CrsTransform>(
      std::make_shared<ProjTransform>(std::move(to_layer), std::move(to_wgs84)));
}

}  // namespace lodestone
