#include "storage/dem/mask_grid.h"

#include <cpl_conv.h>
#include <cpl_string.h>
#include <gdal_priv.h>
#include <gdalwarper.h>
#include <ogr_spatialref.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <optional>

#include "storage/dem/raster_source.h"

namespace lodestone {
namespace {

constexpr int kFinestLevel = 3;
constexpr int kCoarsestLevel = -16;
constexpr double kMaxWarpedPixels = 268435456.0;  // 2^28
constexpr double kPixelTolerance = 1e-3;          // of a mask pixel at the level in question
constexpr int kStepsPerEdge = 32;

// The mask's pixel edges in data cells from the layer's north-west post, when its axes are the layer's own.
struct CellGrid {
  double x0 = 0, y0 = 0, dx = 1, dy = 1;
};

bool is_whole(double v, double tolerance) { return std::abs(v - std::round(v)) <= tolerance; }

bool is_exact_at(const CellGrid& g, const GreyRaster& mask, int level) {
  const double s = std::ldexp(1.0, level);
  return g.dx * s > 0.5 && g.dy * s > 0.5 && is_whole(g.x0 * s, kPixelTolerance) &&
         is_whole(g.y0 * s, kPixelTolerance) && is_whole(g.dx * s, kPixelTolerance / mask.width) &&
         is_whole(g.dy * s, kPixelTolerance / mask.height);
}

struct TransformerCloser {
  void operator()(void* t) const noexcept { GDALDestroyGenImgProjTransformer(t); }
};
using Transformer = std::unique_ptr<void, TransformerCloser>;

// Adds pixels of one tile to the mask, unless they are all 0.
void keep_tile(WarpedMask& out, std::int64_t row, std::int64_t column, std::vector<std::uint8_t> pixels,
               double& sum) {
  std::uint64_t tile_sum = 0;
  for (const std::uint8_t v : pixels) tile_sum += v;
  if (tile_sum == 0) return;
  sum += static_cast<double>(tile_sum);
  out.tiles.emplace(std::pair{row, column}, std::move(pixels));
}

}  // namespace

std::int64_t mask_pixels(std::int64_t cells, int level) {
  return level >= 0 ? cells << level : ceil_shift(cells, -level);
}

std::array<double, 6> mask_transform(const LayerInfo& layer, int level) {
  const auto corner = layer.world_from_post(layer.base_level, static_cast<double>(layer.world.i0),
                                            static_cast<double>(layer.world.j0));
  const auto step = [level](double v) { return std::ldexp(v, -level); };
  return {corner[0], step(layer.transform[1]), step(layer.transform[2]),
          corner[1], step(layer.transform[4]), step(layer.transform[5])};
}

Result<WarpedMask> warp_mask(const GreyRaster& mask, const LayerInfo& layer) {
  prepare_gdal();
  const QuietGdal quiet;
  const std::int64_t cells_x = layer.world.width() - 1, cells_y = layer.world.height() - 1;
  if (cells_x < 1 || cells_y < 1)
    return Error{ErrorCode::kInvalidArgument, "mask: layer " + layer.name + " has no cells to mask"};

  // The mask as a raster in memory, and its place.
  OGRSpatialReference layer_crs, mask_crs;
  layer_crs.SetFromUserInput(layer.crs_wkt.c_str());
  layer_crs.SetAxisMappingStrategy(OAMS_TRADITIONAL_GIS_ORDER);
  mask_crs = layer_crs;
  if (!mask.crs_wkt.empty()) {
    if (mask_crs.SetFromUserInput(mask.crs_wkt.c_str()) != OGRERR_NONE)
      return Error{ErrorCode::kUnsupported, "mask: its reference system cannot be read"};
    mask_crs.SetAxisMappingStrategy(OAMS_TRADITIONAL_GIS_ORDER);
  }
  auto transform = mask_transform(layer, 0);
  if (mask.transform) {
    transform = *mask.transform;
  } else {
    const double sx = static_cast<double>(cells_x) / mask.width,
                 sy = static_cast<double>(cells_y) / mask.height;
    transform = {transform[0], transform[1] * sx, transform[2] * sy,
                 transform[3], transform[4] * sx, transform[5] * sy};
  }
  const DatasetPtr source(GetGDALDriverManager()->GetDriverByName("MEM")->Create("", mask.width, mask.height,
                                                                                 0, GDT_Byte, nullptr));
  const std::string address =
      CPLSPrintf("DATAPOINTER=%llu",
                 static_cast<unsigned long long>(reinterpret_cast<std::uintptr_t>(mask.pixels.data())));
  char** band_options = CSLAddString(nullptr, address.c_str());
  const bool is_added = source && source->AddBand(GDT_Byte, band_options) == CE_None;
  CSLDestroy(band_options);
  if (!is_added) return Error{ErrorCode::kInternal, "mask: no memory raster"};
  source->SetGeoTransform(transform.data());
  source->SetSpatialRef(&mask_crs);

  // Where its outline falls, in cells from the layer's north-west post.
  const char* same_options[] = {"IGNORE_DATA_AXIS_TO_SRS_AXIS_MAPPING=YES", "CRITERION=EQUIVALENT", nullptr};
  const bool is_same_crs = mask_crs.IsSame(&layer_crs, same_options) != 0;
  std::unique_ptr<OGRCoordinateTransformation> to_layer;
  if (!is_same_crs) {
    to_layer.reset(OGRCreateCoordinateTransformation(&mask_crs, &layer_crs));
    if (!to_layer)
      return Error{ErrorCode::kUnsupported,
                   "mask: no transformation from its reference system to the layer's " + layer.crs_name};
  }
  const auto cell_at = [&](double px, double py) -> std::optional<std::array<double, 2>> {
    double x = transform[0] + px * transform[1] + py * transform[2],
           y = transform[3] + px * transform[4] + py * transform[5];
    if (to_layer && !to_layer->Transform(1, &x, &y)) return std::nullopt;
    const auto post = layer.post_from_world(layer.base_level, x, y);
    if (!std::isfinite(post[0]) || !std::isfinite(post[1])) return std::nullopt;
    return std::array{post[0] - static_cast<double>(layer.world.i0),
                      post[1] - static_cast<double>(layer.world.j0)};
  };
  double left = std::numeric_limits<double>::infinity(), right = -left, top = left, bottom = -left;
  for (int a = 0; a <= kStepsPerEdge; ++a) {
    for (int b = 0; b <= kStepsPerEdge; ++b) {
      const auto p = cell_at(static_cast<double>(mask.width) * a / kStepsPerEdge,
                             static_cast<double>(mask.height) * b / kStepsPerEdge);
      if (!p) continue;
      left = std::min(left, (*p)[0]);
      right = std::max(right, (*p)[0]);
      top = std::min(top, (*p)[1]);
      bottom = std::max(bottom, (*p)[1]);
    }
  }
  if (!(left < static_cast<double>(cells_x) && right > 0 && top < static_cast<double>(cells_y) &&
        bottom > 0)) {
    return Error{ErrorCode::kInvalidArgument,
                 "mask: it does not touch layer " + layer.name + "; check its georeference"};
  }
  // The outline is sampled: a curved edge may bulge by a little between samples.
  const double margin_x = is_same_crs ? 0 : (right - left) / 100 + 1,
               margin_y = is_same_crs ? 0 : (bottom - top) / 100 + 1;
  left = std::max(left - margin_x, 0.0);
  top = std::max(top - margin_y, 0.0);
  right = std::min(right + margin_x, static_cast<double>(cells_x));
  bottom = std::min(bottom + margin_y, static_cast<double>(cells_y));

  // The level: exact if the pixels allow it, else the nearest in size.
  WarpedMask out;
  const auto origin = cell_at(0, 0), east = cell_at(mask.width, 0), south = cell_at(0, mask.height);
  std::optional<CellGrid> grid;
  if (is_same_crs && origin && east && south && std::abs((*east)[1] - (*origin)[1]) < kPixelTolerance &&
      std::abs((*south)[0] - (*origin)[0]) < kPixelTolerance) {
    grid = CellGrid{(*origin)[0], (*origin)[1], ((*east)[0] - (*origin)[0]) / mask.width,
                    ((*south)[1] - (*origin)[1]) / mask.height};
    if (grid->dx <= 0 || grid->dy <= 0) grid.reset();
  }
  const auto size_at = [&](int level) {
    return (right - left) * (bottom - top) * std::ldexp(1.0, 2 * level);
  };
  std::optional<int> exact;
  for (int level = 0; grid && level <= kFinestLevel && !exact; ++level) {
    if (is_exact_at(*grid, mask, level) && size_at(level) <= kMaxWarpedPixels) exact = level;
  }
  if (exact) {
    out.level = *exact;
  } else {
    const double pixel =
        std::sqrt((right - left) * (bottom - top) / (static_cast<double>(mask.width) * mask.height));
    out.level = std::clamp(static_cast<int>(std::lround(-std::log2(std::max(pixel, 1e-6)))), 0, kFinestLevel);
    while (out.level > kCoarsestLevel && size_at(out.level) > kMaxWarpedPixels) --out.level;
  }

  // Tile by tile over the outline.
  const double s = std::ldexp(1.0, out.level);
  const std::int64_t width = mask_pixels(cells_x, out.level), height = mask_pixels(cells_y, out.level);
  const auto first = [&](double cell) {
    return static_cast<std::int64_t>(std::floor(cell * s + kPixelTolerance));
  };
  const auto last = [&](double cell, std::int64_t count) {
    return std::min(static_cast<std::int64_t>(std::ceil(cell * s - kPixelTolerance)), count) - 1;
  };
  const PostWindow box{first(left), first(top), last(right, width), last(bottom, height)};
  if (box.is_empty())
    return Error{ErrorCode::kInvalidArgument,
                 "mask: it does not touch layer " + layer.name + "; check its georeference"};
  Transformer transformer;
  DatasetPtr warped;
  if (!exact) {
    auto target = mask_transform(layer, out.level);
    target[0] += static_cast<double>(box.i0) * target[1] + static_cast<double>(box.j0) * target[2];
    target[3] += static_cast<double>(box.i0) * target[4] + static_cast<double>(box.j0) * target[5];
    GDALWarpOptions* options = GDALCreateWarpOptions();
    char** to = CSLSetNameValue(nullptr, "DST_SRS", layer.crs_wkt.c_str());
    options->hSrcDS = source.get();
    options->pTransformerArg = GDALCreateGenImgProjTransformer2(source.get(), nullptr, to);
    CSLDestroy(to);
    if (options->pTransformerArg != nullptr) {
      GDALSetGenImgProjTransformerDstGeoTransform(options->pTransformerArg, target.data());
      options->pfnTransformer = GDALGenImgProjTransform;
      options->eResampleAlg = GRA_Average;
      options->eWorkingDataType = GDT_Byte;
      options->nBandCount = 1;
      options->panSrcBands = static_cast<int*>(CPLMalloc(sizeof(int)));
      options->panDstBands = static_cast<int*>(CPLMalloc(sizeof(int)));
      options->panSrcBands[0] = options->panDstBands[0] = 1;
      options->papszWarpOptions = CSLSetNameValue(options->papszWarpOptions, "INIT_DEST", "0");
      warped.reset(static_cast<GDALDataset*>(GDALCreateWarpedVRT(source.get(), static_cast<int>(box.width()),
                                                                 static_cast<int>(box.height()),
                                                                 target.data(), options)));
    }
    GDALDestroyWarpOptions(options);
    if (!warped)
      return Error{ErrorCode::kUnsupported,
                   std::string("mask: cannot be warped to the layer: ") + CPLGetLastErrorMsg()};
  }
  double sum = 0;
  for (std::int64_t row = box.j0 / kMaskTile; row <= box.j1 / kMaskTile; ++row) {
    for (std::int64_t column = box.i0 / kMaskTile; column <= box.i1 / kMaskTile; ++column) {
      std::vector<std::uint8_t> pixels(std::size_t{kMaskTile} * kMaskTile);
      const std::int64_t i0 = std::max(box.i0, column * kMaskTile),
                         i1 = std::min(box.i1, (column + 1) * kMaskTile - 1);
      const std::int64_t j0 = std::max(box.j0, row * kMaskTile),
                         j1 = std::min(box.j1, (row + 1) * kMaskTile - 1);
      std::uint8_t* corner =
          &pixels[static_cast<std::size_t>((j0 - row * kMaskTile) * kMaskTile + i0 - column * kMaskTile)];
      if (warped) {
        if (warped->GetRasterBand(1)->RasterIO(GF_Read, static_cast<int>(i0 - box.i0),
                                               static_cast<int>(j0 - box.j0), static_cast<int>(i1 - i0 + 1),
                                               static_cast<int>(j1 - j0 + 1), corner,
                                               static_cast<int>(i1 - i0 + 1), static_cast<int>(j1 - j0 + 1),
                                               GDT_Byte, 1, kMaskTile, nullptr) != CE_None) {
          return Error{ErrorCode::kUnsupported,
                       std::string("mask: cannot be warped to the layer: ") + CPLGetLastErrorMsg()};
        }
      } else {
        for (std::int64_t j = j0; j <= j1; ++j) {
          const auto y = std::clamp<std::int64_t>(
              static_cast<std::int64_t>(
                  std::floor(((static_cast<double>(j) + 0.5) / s - grid->y0) / grid->dy)),
              0, mask.height - 1);
          for (std::int64_t i = i0; i <= i1; ++i) {
            const auto x = std::clamp<std::int64_t>(
                static_cast<std::int64_t>(
                    std::floor(((static_cast<double>(i) + 0.5) / s - grid->x0) / grid->dx)),
                0, mask.width - 1);
            corner[(j - j0) * kMaskTile + i - i0] = mask.pixels[static_cast<std::size_t>(y * mask.width + x)];
          }
        }
      }
      keep_tile(out, row, column, std::move(pixels), sum);
    }
  }
  out.mean = sum / 255 / (static_cast<double>(width) * static_cast<double>(height));
  return out;
}

}  // namespace lodestone
