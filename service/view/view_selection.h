#pragma once
// View selection: the fewest tiles that show a camera the ground at a stated screen error.
// Source: Hu & Wang sections 3.1-3.3; SPEC-SYNTHESIS 5.6, 5.8.
//
// All geometry is done on the layer's plane: x east and y north in metres along the posts' columns and rows, z the height. A cell
// has the size that it has on the ground under the camera (the nearest place of the data); the Earth's curvature is left out.

#include <array>
#include <cstdint>
#include <vector>

#include "service/view/height_bounds.h"

namespace lodestone {

using Vec3 = std::array<double, 3>;

// A pinhole camera on the plane.
struct Camera {
  Vec3 eye_m{};
  Vec3 forward{0, 1, 0};     // unit length
  double fov_y_rad = 1.0471975511965976;
  double width_px = 1920, height_px = 1080;
  double cell_x_m = 1, cell_y_m = 1;  // base cell under the camera
};

struct ViewOptions {
  double max_error_px = 2;
  bool is_balanced = true;
  int max_iterations = kMaxDepth;  // deepest level below base; the recipe's depth_limit holds too
};

struct ViewTile {
  TileId id;
  double distance_m = 0;  // from the eye to the nearest place where the tile's ground can be; 0: the eye may be inside
  double error_px = 0;    // what the tile's post spacing covers on the screen at that distance (eq. 3)
  int iterations = 0;     // levels below base
};

struct ViewAnswer {
  std::vector<ViewTile> tiles;  // nearest first; no tile lies in another
  int culled_frustum = 0, culled_facing = 0;  // subtrees that each test removed
  double visible_ground_m2 = 0;  // of the tiles' footprints inside the viewing volume, at their middle height
};

inline constexpr std::size_t kMostViewTiles = 16384;

// Errors: kInvalidArgument ("eye": below the ground; "max_error_px": more than kMostViewTiles tiles), those of HeightBounds.
Result<ViewAnswer> select_view(const HeightBounds& bounds, const Recipe& recipe, const Camera& camera, const ViewOptions& options);

// What a tile of level z covers on the screen, eq. 3: its post spacing at that distance, pixels. Infinite at distance 0.
double view_error_px(const LayerInfo& info, int z, double distance_m, const Camera& camera);

// Half-spaces of the viewing volume, each dot(normal, p - eye) >= 0: before the eye, left, right, bottom, top.
std::array<Vec3, 5> view_planes(const Camera& camera);

// A place on the plane of camera cells `cell_x_m`, `cell_y_m` from base posts, and the other way round.
inline std::array<double, 2> plane_from_post(double i, double j, double cell_x_m, double cell_y_m) { return {i * cell_x_m, -j * cell_y_m}; }

// Camera at `eye` looking along `direction` or at `target` (world coordinates of the layer's CRS, heights in metres). Scales the
// plane for the eye. Errors: kInvalidArgument naming the field: target equal to eye.
struct CameraPlace {
  Vec3 eye{};
  bool has_target = true;
  Vec3 look{};  // target, or a direction in metres east, north, up
};
Result<Camera> camera_from_world(const Layer& layer, const CameraPlace& place);

}  // namespace lodestone
