#pragma once
// The other raster forms of a height tile: raw float32, GeoTIFF, and PNG as terrain-RGB or shaded picture.
// All bytes are pure functions of the arguments.

#include <array>
#include <cstdint>
#include <span>
#include <string>

#include "kernels/types/result.h"
#include "storage/formats/exr_tile.h"

namespace lodestone {

// posts * posts little-endian float32, rows from the north, nothing else.
std::string encode_f32_tile(std::span<const float> heights_m);

// Float32 GeoTIFF, pixel-is-point, post (0,0) at the transform's origin; crs_wkt; nodata tag absent; deflate + predictor 3.
// transform: GDAL order for posts (see PostTransform). Attributes go into the metadata as
// layer, recipe, revision, seed, tile (z/x/y), unit, datum, height_min_m, height_max_m.
// Errors: kInvalidArgument (sizes, text that is no WKT; an empty crs_wkt is allowed), kInternal.
Result<std::string> encode_tiff_tile(std::span<const float> heights_m, int posts, const std::array<double, 6>& transform,
                                     const std::string& crs_wkt, const TileAttributes& attributes);

enum class PngEncoding : std::uint8_t { kTerrarium, kMapbox, kHillshade, kRelief };

// size = posts: one pixel per post. size = posts - 1: pixel centres, the mean of the four surrounding posts.
// terrarium: h = R*256 + G + B/256 - 32768; mapbox: h = -10000 + (R*65536 + G*256 + B) * 0.1; rounded to nearest, clamped.
// hillshade: 8-bit grey, light from azimuth 315, altitude 45 degrees, Horn's gradient; cell_x_m, cell_y_m: post spacing on
// the ground. relief: hypsometric tint multiplied by the hillshade, RGB; range_m: heights of the lowest and highest tint.
// Gradients at the tile's border need the neighbours' posts: heights_m may come with `halo` extra posts on every side;
// without, the border continues the slope inside. Errors: kInvalidArgument (names the rule), kInternal.
Result<std::string> encode_png_tile(std::span<const float> heights_m, int posts, int halo, PngEncoding encoding, int size,
                                    double cell_x_m, double cell_y_m, std::array<double, 2> range_m = {0, 4000});

}  // namespace lodestone
