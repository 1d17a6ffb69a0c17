#include "storage/dem/raster_source.h"

#include <cpl_conv.h>
#include <cpl_error.h>
#include <cpl_string.h>
#include <gdal_priv.h>
#include <gdalwarper.h>
#include <ogr_spatialref.h>

#include <algorithm>
#include <cctype>
#include <cmath>
#include <limits>
#include <mutex>

#include "storage/dem/ground.h"

namespace lodestone {
namespace {

constexpr std::int64_t kMaxSide = std::int64_t{1} << 24;
constexpr double kMaxDeclaredBytes = 1099511627776.0;  // 2^40
constexpr double kBombBytes = 1073741824.0;            // 2^30; from here on, a file must hold at least
constexpr double kMaxPacking = 1000;                   // one byte per so many decoded ones
constexpr double kPostTolerance = 1e-3;                // of a post, between sources of a native grid
constexpr float kMaxHeightM = 1e6F;                    // beyond: an untagged nodata value, never ground
constexpr double kUsFootM = 1200.0 / 3937.0;
constexpr GIntBig kBlockCacheBytes = GIntBig{96} << 20;
constexpr double kWarpMemoryBytes = 32.0 * 1024 * 1024;
constexpr double kMercatorHalfM = 20037508.342789244;
constexpr const char* kDrivers[] = {"GTiff", "COG",         "SRTMHGT", "USGSDEM", "AAIGrid",
                                    "PNG",   "JP2OpenJPEG", "ENVI",    "EHdr"};

std::string lower(std::string text) {
  std::transform(text.begin(), text.end(), text.begin(),
                 [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
  return text;
}

Error source_error(ErrorCode code, const std::string& path, const std::string& what) {
  return Error{code, "source " + path + ": " + what};
}

// Archives on local disk are read in place; everything that could reach the network is refused.
bool has_local_prefixes(const std::string& path) {
  for (std::size_t at = path.find("/vsi"); at != std::string::npos; at = path.find("/vsi", at + 1)) {
    const auto starts = [&](const char* prefix) {
      return path.compare(at, std::string(prefix).size(), prefix) == 0;
    };
    if (!starts("/vsizip/") && !starts("/vsigzip/") && !starts("/vsitar/") && !starts("/vsimem/"))
      return false;
  }
  return true;
}

bool is_vrt(const std::string& path) {
  const std::string name = lower(path);
  return name.size() > 4 && name.compare(name.size() - 4, 4, ".vrt") == 0;
}

Result<DatasetPtr> open_raster(const std::string& path) {
  std::vector<const char*> drivers(std::begin(kDrivers), std::end(kDrivers));
  if (is_vrt(path)) drivers.push_back("VRT");
  drivers.push_back(nullptr);
  if (!has_local_prefixes(path)) {
    return source_error(
        ErrorCode::kUnsupported, path,
        "only local files, /vsizip/, /vsigzip/ and /vsitar/ are read; copy the raster to this machine");
  }
  std::error_code ec;
  if (path.compare(0, 4, "/vsi") != 0 && !std::filesystem::exists(path, ec)) {
    return source_error(ErrorCode::kNotFound, path, "no such file");
  }
  if (path.compare(0, 4, "/vsi") != 0 && !std::filesystem::is_regular_file(path, ec)) {
    return source_error(ErrorCode::kUnsupported, path, "is no regular file; a pipe or a device cannot be read as a raster");
  }
  CPLErrorReset();
  DatasetPtr dataset(static_cast<GDALDataset*>(
      GDALOpenEx(path.c_str(), GDAL_OF_RASTER | GDAL_OF_READONLY | GDAL_OF_VERBOSE_ERROR, drivers.data(),
                 nullptr, nullptr)));
  if (!dataset) {
    const std::string reason = CPLGetLastErrorMsg();
    const bool is_other_format = reason.find("not recognized as a supported") != std::string::npos;
    return source_error(is_other_format || reason.empty() ? ErrorCode::kUnsupported : ErrorCode::kCorrupt,
                        path,
                        "cannot be opened as GeoTIFF, SRTM .hgt, USGS DEM, Arc/Info ASCII grid, PNG, JPEG "
                        "2000, ENVI or EHdr (VRT only when named .vrt)" +
                            (reason.empty() ? std::string() : ": " + reason));
  }
  return dataset;
}

// Metres per vertical unit; NaN if the text is no unit of length that we know.
double unit_from_text(const std::string& text) {
  const std::string u = lower(text);
  for (const char* m : {"", "m", "metre", "metres", "meter", "meters"}) {
    if (u == m) return 1;
  }
  for (const char* ft : {"ft", "foot", "feet", "international foot"}) {
    if (u == ft) return 0.3048;
  }
  for (const char* us : {"us-ft", "us_ft", "ftus", "us survey foot", "us survey feet", "foot_us"}) {
    if (u == us) return kUsFootM;
  }
  if (u == "cm") return 0.01;
  return std::numeric_limits<double>::quiet_NaN();
}

Result<double> vertical_unit_m(const IngestOptions& options, const std::string& path, GDALRasterBand& band,
                               const OGRSpatialReference& crs) {
  if (!options.unit.empty()) {
    const double m = unit_from_text(options.unit);
    if (std::isfinite(m)) return m;
    return Error{ErrorCode::kInvalidArgument,
                 "vertical unit \"" + options.unit + "\" is unknown; use m, ft or us-ft"};
  }
  const std::string tagged = band.GetUnitType();
  if (!tagged.empty()) {
    const double m = unit_from_text(tagged);
    if (std::isfinite(m)) return m;
    return source_error(
        ErrorCode::kUnsupported, path,
        "vertical unit \"" + tagged + "\" is unknown; say which it is with --unit m, ft or us-ft");
  }
  if (!vertical_datum_of(crs).empty()) {
    const double m = crs.GetTargetLinearUnits("VERT_CS");
    if (m > 0) return m;
  }
  return 1.0;
}

// The file's transform for pixel centres, with columns eastwards and rows southwards where the grid is not
// rotated.
Result<PostTransform> post_transform(const std::string& path, GDALDataset& dataset, PlannedRaster& raster) {
  double g[6] = {};
  const bool is_placed = dataset.GetGeoTransform(g) == CE_None;
  const double det = g[1] * g[5] - g[2] * g[4];
  if (!is_placed) {
    return source_error(ErrorCode::kUnsupported, path,
                        dataset.GetGCPCount() > 0
                            ? "placed by ground control points only; warp it first with gdalwarp"
                            : "has no georeference; give it one with gdal_translate -a_srs ... -a_ullr ...");
  }
  if (!std::isfinite(det) || det == 0 || !std::all_of(g, g + 6, [](double v) { return std::isfinite(v); })) {
    return source_error(ErrorCode::kCorrupt, path,
                        "its geotransform has no area; set it with gdal_translate -a_ullr");
  }
  PostTransform t{g[0] + 0.5 * (g[1] + g[2]), g[1], g[2], g[3] + 0.5 * (g[4] + g[5]), g[4], g[5]};
  if (g[2] == 0 && g[4] == 0) {
    raster.flip_x = t[1] < 0;
    raster.flip_y = t[5] > 0;
    if (raster.flip_x) t = {t[0] + t[1] * static_cast<double>(raster.width - 1), -t[1], 0, t[3], 0, t[5]};
    if (raster.flip_y) t = {t[0], t[1], 0, t[3] + t[5] * static_cast<double>(raster.height - 1), 0, -t[5]};
  }
  return t;
}

Result<void> check_band(const IngestOptions& options, const std::string& path, GDALDataset& dataset,
                        PlannedRaster& raster) {
  raster.path = path;
  raster.width = dataset.GetRasterXSize();
  raster.height = dataset.GetRasterYSize();
  if (raster.width < 1 || raster.height < 1 || dataset.GetRasterCount() < 1) {
    return source_error(ErrorCode::kUnsupported, path, "has no pixels");
  }
  if (options.band < 1 || options.band > dataset.GetRasterCount()) {
    return source_error(ErrorCode::kInvalidArgument, path,
                        "band " + std::to_string(options.band) + " was asked for, it has bands 1 to " +
                            std::to_string(dataset.GetRasterCount()));
  }
  GDALRasterBand& band = *dataset.GetRasterBand(options.band);
  const GDALDataType type = band.GetRasterDataType();
  const double declared =
      static_cast<double>(raster.width) * static_cast<double>(raster.height) * GDALGetDataTypeSizeBytes(type);
  if (raster.width > kMaxSide || raster.height > kMaxSide || declared > kMaxDeclaredBytes) {
    return source_error(
        ErrorCode::kTooLarge, path,
        std::to_string(raster.width) + " x " + std::to_string(raster.height) +
            " pixels; at most 2^24 a side and 2^40 bytes decoded; ingest it in parts as several layers");
  }
  // A VRT is small by nature; the operator vouches for what it names.
  VSIStatBufL file{};
  if (declared > kBombBytes && !is_vrt(path) && VSIStatL(path.c_str(), &file) == 0 &&
      declared > kMaxPacking * static_cast<double>(file.st_size)) {
    return source_error(ErrorCode::kTooLarge, path,
                        std::to_string(raster.width) + " x " + std::to_string(raster.height) + " pixels in " +
                            std::to_string(file.st_size) +
                            " bytes: packed more than 1000 to 1, as no terrain is; cut it to the part that holds data "
                            "(gdal_translate -projwin), or name it in a .vrt");
  }
  if (GDALDataTypeIsComplex(type))
    return source_error(ErrorCode::kUnsupported, path, "its band is of complex numbers, not heights");
  if (band.GetColorTable() != nullptr) {
    return source_error(
        ErrorCode::kUnsupported, path,
        "its band has a colour table: categories or a picture, not heights; choose another band with --band");
  }
  raster.is_wide = type == GDT_Int32 || type == GDT_UInt32 || type == GDT_Float64 || type == GDT_Int64 ||
                   type == GDT_UInt64;
  int has = 0;
  raster.nodata = band.GetNoDataValue(&has);
  if (type == GDT_Int64) raster.nodata = static_cast<double>(band.GetNoDataValueAsInt64(&has));
  if (type == GDT_UInt64) raster.nodata = static_cast<double>(band.GetNoDataValueAsUInt64(&has));
  raster.has_nodata = has != 0 && !std::isnan(raster.nodata);
  if (options.nodata) {
    raster.has_nodata = !std::isnan(*options.nodata);
    raster.nodata = *options.nodata;
  }
  raster.has_mask = (band.GetMaskFlags() & (GMF_ALL_VALID | GMF_NODATA)) == 0;
  raster.scale = band.GetScale(&has);
  raster.offset = band.GetOffset(&has);
  if (!std::isfinite(raster.scale) || raster.scale == 0 || !std::isfinite(raster.offset)) {
    return source_error(ErrorCode::kUnsupported, path,
                        "its scale is zero or not a number; set it with gdal_translate -a_scale");
  }
  band.GetBlockSize(&raster.block_width, &raster.block_height);
  return {};
}

// Places raster `n` on the grid of the first; widens the world to hold it (indices of the first raster's
// posts).
Result<void> place_native(RasterPlan& plan, std::size_t n, const PostTransform& t,
                          const OGRSpatialReference& crs, const OGRSpatialReference& first_crs) {
  PlannedRaster& r = plan.rasters[n];
  LayerInfo& info = plan.info;
  const char* advice =
      "; ingest it as a layer of its own, or choose --grid WorldCRS84Quad or WebMercatorQuad";
  if (n > 0) {
    const char* options[] = {"IGNORE_DATA_AXIS_TO_SRS_AXIS_MAPPING=YES", "CRITERION=EQUIVALENT", nullptr};
    if (!crs.IsSame(&first_crs, options)) {
      return source_error(ErrorCode::kInvalidArgument, r.path,
                          "its reference system " + crs_display_name(crs) + " differs from that of " +
                              plan.rasters[0].path + " (" + info.crs_name + ")" + advice);
    }
    // Both outer corners must fall on posts of the first raster.
    const auto from = info.post_from_world(info.base_level, t[0], t[3]);
    const double w = static_cast<double>(r.width - 1), h = static_cast<double>(r.height - 1);
    const auto to =
        info.post_from_world(info.base_level, t[0] + w * t[1] + h * t[2], t[3] + w * t[4] + h * t[5]);
    const double off =
        std::max({std::abs(from[0] - std::round(from[0])), std::abs(from[1] - std::round(from[1])),
                  std::abs(to[0] - std::round(from[0]) - w), std::abs(to[1] - std::round(from[1]) - h)});
    if (!(off <= kPostTolerance)) {
      return source_error(ErrorCode::kInvalidArgument, r.path,
                          "its posts lie " + std::to_string(off) + " posts beside those of " +
                              plan.rasters[0].path + ", at most 0.001 is allowed" + advice);
    }
    r.i0 = std::llround(from[0]);
    r.j0 = std::llround(from[1]);
  }
  info.world = {std::min(info.world.i0, r.i0), std::min(info.world.j0, r.j0),
                std::max(info.world.i1, r.i0 + r.width - 1), std::max(info.world.j1, r.j0 + r.height - 1)};
  return {};
}

Result<void> finish_native(RasterPlan& plan) {
  LayerInfo& info = plan.info;
  const auto origin = info.world_from_post(info.base_level, static_cast<double>(info.world.i0),
                                           static_cast<double>(info.world.j0));
  info.transform[0] = origin[0];
  info.transform[3] = origin[1];
  for (PlannedRaster& r : plan.rasters) {
    r.i0 -= info.world.i0;
    r.j0 -= info.world.j0;
  }
  info.world = {0, 0, info.world.width() - 1, info.world.height() - 1};
  if (info.world.i1 >= kMaxSide || info.world.j1 >= kMaxSide) {
    return Error{ErrorCode::kTooLarge, "layer " + info.name + ": the sources together span " +
                                           std::to_string(info.world.width()) + " x " +
                                           std::to_string(info.world.height()) +
                                           " posts, at most 2^24 a side; ingest them as several layers"};
  }
  info.base_level = 0;
  while ((static_cast<std::int64_t>(info.cells_per_tile()) << info.base_level) <
         std::max(info.world.i1, info.world.j1))
    ++info.base_level;
  return {};
}

// Quad grids: the level whose posts are nearest to the data's and not coarser; the world is whole tiles
// around the data.
Result<void> place_quad(RasterPlan& plan, const std::vector<DatasetPtr>& files) {
  LayerInfo& info = plan.info;
  OGRSpatialReference crs;
  const bool is_geographic = info.grid == GridKind::kWorldCrs84Quad;
  crs.SetFromUserInput(is_geographic ? "OGC:CRS84" : "EPSG:3857");
  char* wkt = nullptr;
  const char* wkt_options[] = {"FORMAT=WKT2_2018", nullptr};
  crs.exportToWkt(&wkt, wkt_options);
  info.crs_wkt = wkt;
  CPLFree(wkt);
  info.crs_name = is_geographic ? "OGC:CRS84" : "EPSG:3857";
  const double west = is_geographic ? -180.0 : -kMercatorHalfM;
  const double north = is_geographic ? 90.0 : kMercatorHalfM;
  const double side = is_geographic ? 180.0 : 2 * kMercatorHalfM;  // of a level-0 tile
  const std::int64_t tiles_x = is_geographic ? 2 : 1;

  double spacing = std::numeric_limits<double>::infinity();
  std::array<double, 4> box{};  // west, south, east, north
  for (std::size_t n = 0; n < files.size(); ++n) {
    const char* to[] = {is_geographic ? "DST_SRS=OGC:CRS84" : "DST_SRS=EPSG:3857", nullptr};
    double g[6] = {};
    double e[4] = {};
    int width = 0, height = 0;
    void* transformer = GDALCreateGenImgProjTransformer2(files[n].get(), nullptr, const_cast<char**>(to));
    const bool ok =
        transformer != nullptr && GDALSuggestedWarpOutput2(files[n].get(), GDALGenImgProjTransform,
                                                           transformer, g, &width, &height, e, 0) == CE_None;
    if (transformer != nullptr) GDALDestroyGenImgProjTransformer(transformer);
    if (!ok)
      return source_error(ErrorCode::kUnsupported, plan.rasters[n].path,
                          "cannot be warped to " + info.crs_name + ": " + CPLGetLastErrorMsg());
    spacing = std::min({spacing, std::abs(g[1]), std::abs(g[5])});
    box = n == 0 ? std::array{e[0], e[1], e[2], e[3]}
                 : std::array{std::min(box[0], e[0]), std::min(box[1], e[1]), std::max(box[2], e[2]),
                              std::max(box[3], e[3])};
  }
  const int cells = info.cells_per_tile();
  info.base_level = 0;
  while (info.base_level < 24 && side / std::ldexp(cells, info.base_level) > spacing * (1 + 1e-6))
    ++info.base_level;
  const double step = side / std::ldexp(cells, info.base_level);
  info.transform = {west, step, 0, north, 0, -step};
  const double tile = step * cells;
  const auto tile_at = [tile](double d, std::int64_t count) {
    return std::clamp<std::int64_t>(static_cast<std::int64_t>(std::floor(d / tile)), 0, count - 1);
  };
  const std::int64_t across = tiles_x << info.base_level, down = std::int64_t{1} << info.base_level;
  const double tiny = step * 1e-6;
  info.world = {tile_at(box[0] - west, across) * cells, tile_at(north - box[3], down) * cells,
                (tile_at(box[2] - west - tiny, across) + 1) * cells,
                (tile_at(north - box[1] - tiny, down) + 1) * cells};
  if (info.world.width() > kMaxSide || info.world.height() > kMaxSide) {
    return Error{ErrorCode::kTooLarge,
                 "layer " + info.name + ": the sources span more than 2^24 posts of level " +
                     std::to_string(info.base_level) + "; ingest them as several layers"};
  }
  for (PlannedRaster& r : plan.rasters) {
    r.i0 = info.world.i0;
    r.j0 = info.world.j0;
  }
  return {};
}

// `file` on the world's posts, made while it is read. Cubic convolution (bilinear would smooth the finest
// band), voids left out.
Result<DatasetPtr> warp_to_world(const RasterPlan& plan, const PlannedRaster& raster, GDALDataset& file) {
  const LayerInfo& info = plan.info;
  const auto corner = info.world_from_post(info.base_level, static_cast<double>(info.world.i0) - 0.5,
                                           static_cast<double>(info.world.j0) - 0.5);
  double g[6] = {corner[0], info.transform[1], 0, corner[1], 0, info.transform[5]};
  const char* to[] = {info.grid == GridKind::kWorldCrs84Quad ? "DST_SRS=OGC:CRS84" : "DST_SRS=EPSG:3857",
                      nullptr};
  void* transformer = GDALCreateGenImgProjTransformer2(&file, nullptr, const_cast<char**>(to));
  if (transformer == nullptr)
    return source_error(ErrorCode::kUnsupported, raster.path,
                        std::string("cannot be warped: ") + CPLGetLastErrorMsg());
  GDALSetGenImgProjTransformerDstGeoTransform(transformer, g);

  GDALWarpOptions* options = GDALCreateWarpOptions();
  options->hSrcDS = &file;
  options->eResampleAlg = GRA_Cubic;
  options->eWorkingDataType = raster.is_wide ? GDT_Float64 : GDT_Float32;
  options->dfWarpMemoryLimit = kWarpMemoryBytes;
  options->nBandCount = 1;
  options->panSrcBands = static_cast<int*>(CPLMalloc(sizeof(int)));
  options->panDstBands = static_cast<int*>(CPLMalloc(sizeof(int)));
  options->panSrcBands[0] = plan.band;
  options->panDstBands[0] = 1;
  options->padfDstNoDataReal = static_cast<double*>(CPLMalloc(sizeof(double)));
  options->padfDstNoDataReal[0] = std::numeric_limits<double>::quiet_NaN();
  options->padfSrcNoDataReal = static_cast<double*>(CPLMalloc(sizeof(double)));
  options->padfSrcNoDataReal[0] =
      raster.has_nodata ? raster.nodata : std::numeric_limits<double>::quiet_NaN();
  options->papszWarpOptions = CSLSetNameValue(options->papszWarpOptions, "INIT_DEST", "NO_DATA");
  options->papszWarpOptions = CSLSetNameValue(options->papszWarpOptions, "UNIFIED_SRC_NODATA", "YES");
  options->pfnTransformer = GDALGenImgProjTransform;
  options->pTransformerArg = transformer;
  DatasetPtr warped(static_cast<GDALDataset*>(GDALCreateWarpedVRT(
      &file, static_cast<int>(info.world.width()), static_cast<int>(info.world.height()), g, options)));
  // The dataset keeps its own copy of the options, and the transformer with it.
  GDALDestroyWarpOptions(options);
  if (!warped)
    return source_error(ErrorCode::kUnsupported, raster.path,
                        std::string("cannot be warped: ") + CPLGetLastErrorMsg());
  return warped;
}

template <class T>
void reverse_axes(std::vector<T>& v, std::size_t width, bool flip_x, bool flip_y) {
  if (flip_y) {
    for (std::size_t a = 0, b = v.size() / width - 1; a < b; ++a, --b)
      std::swap_ranges(v.begin() + static_cast<std::ptrdiff_t>(a * width),
                       v.begin() + static_cast<std::ptrdiff_t>((a + 1) * width),
                       v.begin() + static_cast<std::ptrdiff_t>(b * width));
  }
  if (flip_x) {
    for (std::size_t row = 0; row < v.size(); row += width)
      std::reverse(v.begin() + static_cast<std::ptrdiff_t>(row),
                   v.begin() + static_cast<std::ptrdiff_t>(row + width));
  }
}

}  // namespace

void DatasetCloser::operator()(GDALDataset* dataset) const noexcept { GDALClose(dataset); }

void prepare_gdal() {
  static std::once_flag once;
  std::call_once(once, [] {
    GDALAllRegister();
    GDALSetCacheMax64(kBlockCacheBytes);
    CPLSetConfigOption("GDAL_DISABLE_READDIR_ON_OPEN",
                       "TRUE");  // a folder of ten thousand tiles is not listed for each of them
  });
}

QuietGdal::QuietGdal() { CPLPushErrorHandler(CPLQuietErrorHandler); }
QuietGdal::~QuietGdal() { CPLPopErrorHandler(); }

Result<RasterPlan> plan_rasters(const IngestOptions& options) {
  prepare_gdal();
  const QuietGdal quiet;
  RasterPlan plan;
  plan.band = options.band;
  plan.info.name = options.layer;
  plan.info.grid = options.grid;
  plan.info.posts_per_tile = options.posts_per_tile;
  if (options.sources.empty())
    return Error{ErrorCode::kInvalidArgument, "layer " + options.layer + ": no source raster named"};
  std::vector<DatasetPtr> files;
  OGRSpatialReference first_crs;
  for (const std::string& path : options.sources) {
    auto file = open_raster(path);
    if (!file) return file.error();
    PlannedRaster& raster = plan.rasters.emplace_back();
    if (auto ok = check_band(options, path, **file, raster); !ok) return ok.error();
    auto transform = post_transform(path, **file, raster);
    if (!transform) return transform.error();
    const OGRSpatialReference* crs = (*file)->GetSpatialRef();
    if (crs == nullptr || crs->IsEmpty()) {
      return source_error(ErrorCode::kUnsupported, path,
                          "has no coordinate reference system; give it one with gdal_translate -a_srs");
    }
    auto unit = vertical_unit_m(options, path, *(*file)->GetRasterBand(options.band), *crs);
    if (!unit) return unit.error();
    raster.unit_m = *unit;
    const bool is_first = files.empty();
    if (is_first) {
      first_crs = *crs;
      plan.info.transform = *transform;
      char* wkt = nullptr;
      const char* wkt_options[] = {"FORMAT=WKT2_2018", nullptr};
      crs->exportToWkt(&wkt, wkt_options);
      plan.info.crs_wkt = wkt != nullptr ? wkt : "";
      CPLFree(wkt);
      plan.info.crs_name = crs_display_name(*crs);
      plan.info.datum = !options.datum.empty() ? options.datum : vertical_datum_of(*crs);
      if (plan.info.datum.empty()) plan.info.datum = "unknown";
    }
    plan.info.sources.push_back(std::filesystem::path(path).filename().string());
    if (options.grid == GridKind::kNative) {
      if (is_first) plan.info.world = {0, 0, raster.width - 1, raster.height - 1};
      if (auto ok = place_native(plan, files.size(), *transform, *crs, first_crs); !ok) return ok.error();
    }
    files.push_back(std::move(*file));
  }
  auto placed = options.grid == GridKind::kNative ? finish_native(plan) : place_quad(plan, files);
  if (!placed) return placed.error();
  if (auto ok = locate(plan.info); !ok) return ok.error();
  return plan;
}

Result<RasterReader> RasterReader::open(const RasterPlan& plan) {
  const QuietGdal quiet;
  RasterReader reader;
  reader.plan_ = &plan;
  for (const PlannedRaster& raster : plan.rasters) {
    auto file = open_raster(raster.path);
    if (!file) return file.error();
    if ((*file)->GetRasterXSize() != raster.width || (*file)->GetRasterYSize() != raster.height ||
        (*file)->GetRasterCount() < plan.band) {
      return source_error(ErrorCode::kCorrupt, raster.path, "changed while it was read; ingest it again");
    }
    if (plan.info.grid != GridKind::kNative) {
      auto warped = warp_to_world(plan, raster, **file);
      if (!warped) return warped.error();
      reader.warped_.push_back(std::move(*warped));
    }
    reader.files_.push_back(std::move(*file));
  }
  return reader;
}

Result<void> RasterReader::read(const PostWindow& window, std::vector<float>& heights_m) {
  const QuietGdal quiet;
  const float kVoid = std::numeric_limits<float>::quiet_NaN();
  heights_m.assign(static_cast<std::size_t>(window.width() * window.height()), kVoid);
  bool has_gaps = true;
  for (std::size_t n = 0; n < files_.size() && has_gaps; ++n) {
    const PlannedRaster& r = plan_->rasters[n];
    const bool is_warped = !warped_.empty();
    GDALDataset& dataset = is_warped ? *warped_[n] : *files_[n];
    const std::int64_t width = dataset.GetRasterXSize(), height = dataset.GetRasterYSize();
    const PostWindow part{std::max(window.i0, r.i0), std::max(window.j0, r.j0),
                          std::min(window.i1, r.i0 + width - 1), std::min(window.j1, r.j0 + height - 1)};
    if (part.is_empty()) continue;

    // Raw values, in the order of the layer's posts.
    const bool flip_x = !is_warped && r.flip_x, flip_y = !is_warped && r.flip_y;
    const int w = static_cast<int>(part.width()), h = static_cast<int>(part.height());
    const int x = static_cast<int>(flip_x ? width - 1 - (part.i1 - r.i0) : part.i0 - r.i0);
    const int y = static_cast<int>(flip_y ? height - 1 - (part.j1 - r.j0) : part.j0 - r.j0);
    GDALRasterBand& band = *dataset.GetRasterBand(is_warped ? 1 : plan_->band);
    const std::size_t count = static_cast<std::size_t>(w) * static_cast<std::size_t>(h);
    CPLErrorReset();
    CPLErr code = CE_None;
    if (r.is_wide) {
      wide_.resize(count);
      code = band.RasterIO(GF_Read, x, y, w, h, wide_.data(), w, h, GDT_Float64, 0, 0, nullptr);
      reverse_axes(wide_, static_cast<std::size_t>(w), flip_x, flip_y);
    } else {
      narrow_.resize(count);
      code = band.RasterIO(GF_Read, x, y, w, h, narrow_.data(), w, h, GDT_Float32, 0, 0, nullptr);
      reverse_axes(narrow_, static_cast<std::size_t>(w), flip_x, flip_y);
    }
    const bool has_mask = r.has_mask && !is_warped;
    if (code == CE_None && has_mask) {
      mask_.resize(count);
      code = band.GetMaskBand()->RasterIO(GF_Read, x, y, w, h, mask_.data(), w, h, GDT_Byte, 0, 0, nullptr);
      reverse_axes(mask_, static_cast<std::size_t>(w), flip_x, flip_y);
    }
    if (code != CE_None)
      return source_error(ErrorCode::kCorrupt, r.path,
                          std::string("cannot be read: ") + CPLGetLastErrorMsg());

    // To metres; a post keeps what a source of higher priority gave it.
    const bool is_plain = r.scale == 1 && r.offset == 0 && r.unit_m == 1;
    const auto nodata_f = static_cast<float>(r.nodata);
    has_gaps = part != window;
    for (std::size_t row = 0; row < static_cast<std::size_t>(h); ++row) {
      float* out = &heights_m[static_cast<std::size_t>(
          (part.j0 - window.j0 + static_cast<std::int64_t>(row)) * window.width() + part.i0 - window.i0)];
      for (std::size_t c = 0; c < static_cast<std::size_t>(w); ++c) {
        if (!std::isnan(out[c])) continue;
        const std::size_t k = row * static_cast<std::size_t>(w) + c;
        float value = kVoid;
        if (r.is_wide) {
          const double raw = wide_[k];
          if (!(r.has_nodata && raw == r.nodata))
            value = static_cast<float>((raw * r.scale + r.offset) * r.unit_m);
        } else if (const float raw = narrow_[k]; !(r.has_nodata && raw == nodata_f)) {
          value =
              is_plain ? raw : static_cast<float>((static_cast<double>(raw) * r.scale + r.offset) * r.unit_m);
        }
        if (has_mask && mask_[k] == 0) value = kVoid;
        if (!(std::abs(value) <= kMaxHeightM)) value = kVoid;
        has_gaps |= std::isnan(value);
        out[c] = value;
      }
    }
  }
  return {};
}

}  // namespace lodestone
