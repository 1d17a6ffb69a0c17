#include "storage/formats/raster_tile.h"

#include <cpl_conv.h>
#include <cpl_error.h>
#include <cpl_string.h>
#include <cpl_vsi.h>
#include <gdal_frmts.h>
#include <gdal_priv.h>
#include <ogr_spatialref.h>

#include <atomic>
#include <bit>
#include <memory>
#include <mutex>

namespace lodestone {
namespace {

static_assert(std::endian::native == std::endian::little, "float32 tiles are copied as they lie in memory");

constexpr int kMaxPosts = 1 << 14;

GDALDriver* tiff_driver() {
  static std::once_flag once;
  std::call_once(once, [] {
    if (GDALGetDriverByName("GTiff") == nullptr) GDALRegister_GTiff();
  });
  return GetGDALDriverManager()->GetDriverByName("GTiff");
}

// A private folder in GDAL's memory file system; its name never reaches the bytes.
class MemoryFolder {
 public:
  MemoryFolder() {
    static std::atomic<std::uint64_t> next{0};
    path_ = "/vsimem/lodestone_tiff_" + std::to_string(next.fetch_add(1));
  }
  ~MemoryFolder() { VSIRmdirRecursive(path_.c_str()); }
  MemoryFolder(const MemoryFolder&) = delete;
  MemoryFolder& operator=(const MemoryFolder&) = delete;
  std::string file() const { return path_ + "/tile.tif"; }

 private:
  std::string path_;
};

// Keeps GDAL's messages of this thread from the console; the last one stays readable.
class QuietGdal {
 public:
  QuietGdal() {
    CPLPushErrorHandler(CPLQuietErrorHandler);
    CPLErrorReset();
  }
  ~QuietGdal() { CPLPopErrorHandler(); }
  QuietGdal(const QuietGdal&) = delete;
  QuietGdal& operator=(const QuietGdal&) = delete;
};

Error tiff_error(ErrorCode code, const TileAttributes& a, const std::string& step) {
  return {code, "TIFF tile " + a.layer + " " + std::to_string(a.z) + "/" + std::to_string(a.x) + "/" + std::to_string(a.y) +
                    ": " + step + ": " + CPLGetLastErrorMsg()};
}

void set_metadata(GDALDataset& dataset, const TileAttributes& a) {
  dataset.SetMetadataItem("AREA_OR_POINT", "Point");
  dataset.SetMetadataItem("layer", a.layer.c_str());
  dataset.SetMetadataItem("recipe", a.recipe.c_str());
  dataset.SetMetadataItem("revision", a.revision.c_str());
  dataset.SetMetadataItem("seed", std::to_string(a.seed).c_str());
  dataset.SetMetadataItem("tile", (std::to_string(a.z) + "/" + std::to_string(a.x) + "/" + std::to_string(a.y)).c_str());
  dataset.SetMetadataItem("unit", a.unit.c_str());
  dataset.SetMetadataItem("datum", a.datum.c_str());
  dataset.SetMetadataItem("height_min_m", CPLSPrintf("%.9g", a.height_min_m));
  dataset.SetMetadataItem("height_max_m", CPLSPrintf("%.9g", a.height_max_m));
}

}  // namespace

std::string encode_f32_tile(std::span<const float> heights_m) {
  return {reinterpret_cast<const char*>(heights_m.data()), heights_m.size_bytes()};
}

Result<std::string> encode_tiff_tile(std::span<const float> heights_m, int posts, const std::array<double, 6>& transform,
                                     const std::string& crs_wkt, const TileAttributes& attributes) {
  if (posts < 1 || posts > kMaxPosts || heights_m.size() != static_cast<std::size_t>(posts) * posts) {
    return Error{ErrorCode::kInvalidArgument, "TIFF tile: needs posts * posts heights with posts in 1.." +
                                                  std::to_string(kMaxPosts) + ", got posts = " + std::to_string(posts) +
                                                  " and " + std::to_string(heights_m.size()) + " heights"};
  }
  const QuietGdal quiet;
  GDALDriver* driver = tiff_driver();
  if (driver == nullptr) return tiff_error(ErrorCode::kInternal, attributes, "this GDAL lacks the GTiff driver");

  OGRSpatialReference crs;
  crs.SetAxisMappingStrategy(OAMS_TRADITIONAL_GIS_ORDER);
  if (!crs_wkt.empty() && crs.importFromWkt(crs_wkt.c_str()) != OGRERR_NONE) {
    return tiff_error(ErrorCode::kInvalidArgument, attributes, "the CRS is not WKT");
  }

  const MemoryFolder folder;
  CPLStringList options;
  options.SetNameValue("COMPRESS", "DEFLATE");
  options.SetNameValue("PREDICTOR", "3");
  options.SetNameValue("ZLEVEL", "6");
  options.SetNameValue("NUM_THREADS", "1");
  options.SetNameValue("ENDIANNESS", "LITTLE");
  std::unique_ptr<GDALDataset> dataset(driver->Create(folder.file().c_str(), posts, posts, 1, GDT_Float32, options.List()));
  if (dataset == nullptr) return tiff_error(ErrorCode::kInternal, attributes, "creating");
  set_metadata(*dataset, attributes);

  // GDAL counts from the corner of the first pixel, we from the post at its centre.
  std::array<double, 6> corner = transform;
  corner[0] -= 0.5 * (transform[1] + transform[2]);
  corner[3] -= 0.5 * (transform[4] + transform[5]);
  if (dataset->SetGeoTransform(corner.data()) != CE_None) return tiff_error(ErrorCode::kInternal, attributes, "transform");
  if (!crs_wkt.empty() && dataset->SetSpatialRef(&crs) != CE_None) return tiff_error(ErrorCode::kInternal, attributes, "CRS");
  GDALRasterBand* band = dataset->GetRasterBand(1);
  band->SetDescription("height");
  band->SetUnitType(attributes.unit.c_str());
  if (band->RasterIO(GF_Write, 0, 0, posts, posts, const_cast<float*>(heights_m.data()), posts, posts, GDT_Float32, 0, 0,
                     nullptr) != CE_None) {
    return tiff_error(ErrorCode::kInternal, attributes, "writing posts");
  }
  if (dataset->FlushCache(true); CPLGetLastErrorType() >= CE_Failure) {
    return tiff_error(ErrorCode::kInternal, attributes, "flushing");
  }
  dataset.reset();

  vsi_l_offset size = 0;
  const GByte* data = VSIGetMemFileBuffer(folder.file().c_str(), &size, FALSE);
  if (data == nullptr) return tiff_error(ErrorCode::kInternal, attributes, "reading the finished file");
  return std::string(reinterpret_cast<const char*>(data), size);
}

}  // namespace lodestone
