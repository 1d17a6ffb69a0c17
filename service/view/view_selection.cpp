#include "service/view/view_selection.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <set>

namespace lodestone {
namespace {

Vec3 minus(const Vec3& a, const Vec3& b) { return {a[0] - b[0], a[1] - b[1], a[2] - b[2]}; }
double dot(const Vec3& a, const Vec3& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
Vec3 cross(const Vec3& a, const Vec3& b) { return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]}; }
Vec3 scaled(const Vec3& a, double s) { return {a[0] * s, a[1] * s, a[2] * s}; }
Vec3 plus(const Vec3& a, const Vec3& b) { return {a[0] + b[0], a[1] + b[1], a[2] + b[2]}; }

struct Box {
  Vec3 low{}, high{};
};

// A convex polygon with room for what clipping by five planes can add.
struct Polygon {
  std::array<Vec3, 12> points;
  int count = 0;
};

// Keeps what lies on the inner side of the plane through the eye; points are relative to the eye.
void clip(Polygon& polygon, const Vec3& normal) {
  Polygon out;
  for (int n = 0; n < polygon.count; ++n) {
    const Vec3& a = polygon.points[n];
    const Vec3& b = polygon.points[(n + 1) % polygon.count];
    const double da = dot(normal, a), db = dot(normal, b);
    if (da >= 0) out.points[out.count++] = a;
    if ((da >= 0) != (db >= 0)) out.points[out.count++] = plus(a, scaled(minus(b, a), da / (da - db)));
  }
  polygon = out;
}

// True if box and viewing volume have a point in common. Exact: a volume without end that meets the box either has its tip in it
// or passes through one of its faces.
bool is_in_view(const Box& box, const Vec3& eye, const std::array<Vec3, 5>& planes) {
  const Vec3 low = minus(box.low, eye), high = minus(box.high, eye);
  bool is_inside_all = true;
  for (const Vec3& n : planes) {
    double most = 0, least = 0;
    for (int axis = 0; axis < 3; ++axis) {
      most += std::max(n[axis] * low[axis], n[axis] * high[axis]);
      least += std::min(n[axis] * low[axis], n[axis] * high[axis]);
    }
    if (most < 0) return false;
    is_inside_all = is_inside_all && least >= 0;
  }
  if (is_inside_all) return true;
  if (low[0] <= 0 && high[0] >= 0 && low[1] <= 0 && high[1] >= 0 && low[2] <= 0 && high[2] >= 0) return true;
  for (int axis = 0; axis < 3; ++axis) {
    const int u = (axis + 1) % 3, v = (axis + 2) % 3;
    for (const double at : {low[axis], high[axis]}) {
      Polygon face;
      face.count = 4;
      for (int n = 0; n < 4; ++n) {
        face.points[n][axis] = at;
        face.points[n][u] = n == 0 || n == 3 ? low[u] : high[u];
        face.points[n][v] = n < 2 ? low[v] : high[v];
      }
      for (const Vec3& normal : planes) {
        clip(face, normal);
        if (face.count == 0) break;
      }
      if (face.count > 0) return true;
    }
  }
  return false;
}

double area_in_view(const Box& box, const Vec3& eye, const std::array<Vec3, 5>& planes) {
  const double z = (box.low[2] + box.high[2]) / 2 - eye[2];
  const Vec3 low = minus(box.low, eye), high = minus(box.high, eye);
  Polygon ground;
  ground.count = 4;
  ground.points[0] = {low[0], low[1], z};
  ground.points[1] = {high[0], low[1], z};
  ground.points[2] = {high[0], high[1], z};
  ground.points[3] = {low[0], high[1], z};
  for (const Vec3& normal : planes) {
    clip(ground, normal);
    if (ground.count == 0) return 0;
  }
  double twice = 0;
  for (int n = 0; n < ground.count; ++n) {
    const Vec3& a = ground.points[n];
    const Vec3& b = ground.points[(n + 1) % ground.count];
    twice += a[0] * b[1] - a[1] * b[0];
  }
  return std::abs(twice) / 2;
}

double distance_to(const Box& box, const Vec3& eye) {
  double sum = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const double d = std::max({box.low[axis] - eye[axis], eye[axis] - box.high[axis], 0.0});
    sum += d * d;
  }
  return std::sqrt(sum);
}

// True if no triangle with slopes inside `range` (per metre) anywhere in the box shows its upper side: normal . (eye - a) <= 0.
bool is_turned_away(const Box& box, const Vec3& eye, const std::array<double, 2>& east, const std::array<double, 2>& north) {
  const auto most = [](double s0, double s1, double d0, double d1) { return std::max({-s0 * d0, -s0 * d1, -s1 * d0, -s1 * d1}); };
  return most(east[0], east[1], eye[0] - box.high[0], eye[0] - box.low[0]) + most(north[0], north[1], eye[1] - box.high[1], eye[1] - box.low[1]) +
             (eye[2] - box.low[2]) <= 0;
}

class Selection {
 public:
  Selection(const HeightBounds& bounds, const Recipe& recipe, const Camera& camera, const ViewOptions& options)
      : bounds_(bounds), info_(bounds.layer().info()), recipe_(recipe), camera_(camera), options_(options), planes_(view_planes(camera)),
        deepest_(info_.base_level + std::min({options.max_iterations, recipe.depth_limit, kMaxDepth})) {}

  Result<ViewAnswer> run() {
    if (auto ok = check_eye(); !ok) return ok.error();
    const PostWindow roots = info_.tiles_at(0);
    for (std::int64_t y = roots.j0; y <= roots.j1; ++y) {
      for (std::int64_t x = roots.i0; x <= roots.i1; ++x) {
        if (auto ok = visit({0, x, y}, false); !ok) return ok.error();
      }
    }
    if (options_.is_balanced) {
      if (auto ok = balance(); !ok) return ok.error();
    }
    for (const auto& [id, leaf] : leaves_) {
      answer_.tiles.push_back({id, leaf.distance_m, view_error_px(info_, id.z, leaf.distance_m, camera_), std::max(0, id.z - info_.base_level)});
      answer_.visible_ground_m2 += area_in_view(leaf.box, camera_.eye_m, planes_);
    }
    std::sort(answer_.tiles.begin(), answer_.tiles.end(), [](const ViewTile& a, const ViewTile& b) {
      return a.distance_m != b.distance_m ? a.distance_m < b.distance_m : a.id < b.id;
    });
    return std::move(answer_);
  }

 private:
  struct Leaf {
    Box box;
    double distance_m;
  };

  struct Place {
    Box box;
    std::array<double, 2> east{}, north{};  // slopes of the triangles, per metre
    bool is_open = false;  // heights are not bounded yet: detail may stand out, and only base tiles know how far
  };

  // x and y of the part of the tile that holds data.
  Box footprint(const TileId& id) const {
    const double cells = std::ldexp(static_cast<double>(info_.cells_per_tile()), info_.base_level - id.z);
    const PostWindow& w = info_.world;
    const double i0 = std::clamp(static_cast<double>(id.x) * cells, static_cast<double>(w.i0), static_cast<double>(w.i1));
    const double i1 = std::clamp(static_cast<double>(id.x + 1) * cells, static_cast<double>(w.i0), static_cast<double>(w.i1));
    const double j0 = std::clamp(static_cast<double>(id.y) * cells, static_cast<double>(w.j0), static_cast<double>(w.j1));
    const double j1 = std::clamp(static_cast<double>(id.y + 1) * cells, static_cast<double>(w.j0), static_cast<double>(w.j1));
    return {{i0 * camera_.cell_x_m, -j1 * camera_.cell_y_m, 0}, {i1 * camera_.cell_x_m, -j0 * camera_.cell_y_m, 0}};
  }

  // Height bounds of the tile with all that the camera may be shown of it.
  Result<Place> place(const TileId& id) const {
    Place out;
    out.box = footprint(id);
    const int depth = id.z - info_.base_level;
    auto range = depth > 0 ? bounds_.smooth(id, recipe_) : bounds_.real(id);
    if (!range) return range.error();
    out.box.low[2] = range->low_m;
    out.box.high[2] = range->high_m;
    out.east = {range->east_min / camera_.cell_x_m, range->east_max / camera_.cell_x_m};
    out.north = {-range->south_max / camera_.cell_y_m, -range->south_min / camera_.cell_y_m};
    // Far away, where not even a balanced answer comes near the synthetic levels, the ground is the real one.
    Box flat = out.box;
    flat.low[2] = flat.high[2] = camera_.eye_m[2];
    const bool is_far = view_error_px(info_, info_.base_level, distance_to(flat, camera_.eye_m), camera_) <= 0.25 * options_.max_error_px;
    if (deepest_ <= info_.base_level || (depth <= 0 && is_far)) return out;
    if (depth < 0) {
      out.is_open = true;
      return out;
    }
    auto law = bounds_.detail(floor_shift(id.x, depth), floor_shift(id.y, depth), recipe_);
    if (!law) return law.error();
    double variance_m2 = 0, slope = 0;
    const double cell_m = std::min(camera_.cell_x_m, camera_.cell_y_m);
    for (int n = 0; n < deepest_ - info_.base_level; ++n) {
      variance_m2 += static_cast<double>((*law)[n]) * (*law)[n];
      slope += 2 * kGaussianBound * (*law)[n] / std::ldexp(cell_m, -n - 1);
    }
    const double more_m = kGaussianBound * std::sqrt(variance_m2);
    out.box.low[2] -= more_m;
    out.box.high[2] += more_m;
    for (auto* slopes : {&out.east, &out.north}) {
      (*slopes)[0] -= slope;
      (*slopes)[1] += slope;
    }
    return out;
  }

  Result<void> check_eye() const {
    const double i = camera_.eye_m[0] / camera_.cell_x_m, j = -camera_.eye_m[1] / camera_.cell_y_m;
    const PostWindow& w = info_.world;
    if (i < static_cast<double>(w.i0) || i > static_cast<double>(w.i1) || j < static_cast<double>(w.j0) || j > static_cast<double>(w.j1)) return {};
    auto ground = bounds_.base_height_m(i, j);
    if (!ground) return ground.error();
    const auto tile_of = [&](double post, std::int64_t last) { return std::min(static_cast<std::int64_t>(std::floor(post / info_.cells_per_tile())), last); };
    const PostWindow tiles = info_.tiles_at(info_.base_level);
    auto law = bounds_.detail(tile_of(i, tiles.i1), tile_of(j, tiles.j1), recipe_);
    if (!law) return law.error();
    double variance_m2 = 0;
    for (const float deviation : *law) variance_m2 += static_cast<double>(deviation) * deviation;
    if (camera_.eye_m[2] >= *ground - kGaussianBound * std::sqrt(variance_m2) - 0.01) return {};
    return Error{ErrorCode::kInvalidArgument, fmt::format("eye: height {:.1f} m is inside the ground, which is {:.1f} m high there", camera_.eye_m[2], *ground)};
  }

  // Adds the tile, or its descendants, to the leaves. is_forced: the tile itself is too coarse for its neighbours.
  Result<void> visit(const TileId& id, bool is_forced) {
    auto at = place(id);
    if (!at) return at.error();
    Box tested = at->box;
    if (at->is_open) {
      tested.low[2] -= kOpenHeight_m;
      tested.high[2] += kOpenHeight_m;
    }
    if (!is_in_view(tested, camera_.eye_m, planes_)) {
      ++answer_.culled_frustum;
      return {};
    }
    if (!at->is_open && is_turned_away(at->box, camera_.eye_m, at->east, at->north)) {
      ++answer_.culled_facing;
      return {};
    }
    const double distance_m = distance_to(at->box, camera_.eye_m);
    const bool is_fine = view_error_px(info_, id.z, distance_m, camera_) <= options_.max_error_px;
    if (!is_forced && (is_fine || id.z >= deepest_)) {
      // An open tile stands for what detail its descendants would have; none of them is drawn.
      if (at->is_open && !is_in_view(at->box, camera_.eye_m, planes_)) {
        ++answer_.culled_frustum;
        return {};
      }
      leaves_.emplace(id, Leaf{at->box, distance_m});
      if (leaves_.size() > kMostViewTiles) {
        return Error{ErrorCode::kInvalidArgument, fmt::format("max_error_px: {} pixels need more than {} tiles; ask for a larger error", options_.max_error_px, kMostViewTiles)};
      }
      return {};
    }
    return visit_children(id);
  }

  Result<void> visit_children(const TileId& id) {
    for (int child = 0; child < 4; ++child) {
      const TileId next{id.z + 1, 2 * id.x + (child & 1), 2 * id.y + (child >> 1)};
      if (!info_.has_tile(next)) continue;
      if (auto ok = visit(next, false); !ok) return ok.error();
    }
    return {};
  }

  // Splits leaves that have a neighbour more than one level finer, until there are none.
  Result<void> balance() {
    bool is_changed = true;
    while (is_changed) {
      std::set<TileId> too_coarse;
      for (const auto& [id, leaf] : leaves_) {
        for (const auto& [dx, dy] : {std::pair{-1, 0}, {1, 0}, {0, -1}, {0, 1}}) {
          for (int up = 2; up <= id.z; ++up) {
            const TileId coarse{id.z - up, floor_shift(id.x + dx, up), floor_shift(id.y + dy, up)};
            if (leaves_.count(coarse) != 0) too_coarse.insert(coarse);
          }
        }
      }
      is_changed = !too_coarse.empty();
      for (const TileId& id : too_coarse) {
        leaves_.erase(id);
        if (auto ok = visit_children(id); !ok) return ok.error();
      }
    }
    return {};
  }

  // No ground stands out more than this from what its tile's real heights say.
  static constexpr double kOpenHeight_m = 1e5;

  const HeightBounds& bounds_;
  const LayerInfo& info_;
  const Recipe& recipe_;
  const Camera& camera_;
  const ViewOptions& options_;
  const std::array<Vec3, 5> planes_;
  const int deepest_;
  std::map<TileId, Leaf> leaves_;
  ViewAnswer answer_;
};

}  // namespace

std::array<Vec3, 5> view_planes(const Camera& camera) {
  const Vec3& f = camera.forward;
  // Looking straight up or down, north is the top of the picture (south when looking up).
  const bool is_vertical = std::hypot(f[0], f[1]) < 1e-9;
  const Vec3 upward = is_vertical ? Vec3{0, f[2] < 0 ? 1.0 : -1.0, 0} : Vec3{0, 0, 1};
  Vec3 right = cross(f, upward);
  right = scaled(right, 1 / std::sqrt(dot(right, right)));
  const Vec3 up = cross(right, f);
  const double ty = std::tan(camera.fov_y_rad / 2), tx = ty * camera.width_px / camera.height_px;
  return {f, plus(scaled(f, tx), right), minus(scaled(f, tx), right), plus(scaled(f, ty), up), minus(scaled(f, ty), up)};
}

double view_error_px(const LayerInfo& info, int z, double distance_m, const Camera& camera) {
  const double spacing_m = std::ldexp(std::max(camera.cell_x_m, camera.cell_y_m), info.base_level - z);
  if (!(distance_m > 0)) return std::numeric_limits<double>::infinity();
  return spacing_m * camera.height_px / (2 * distance_m * std::tan(camera.fov_y_rad / 2));
}

Result<ViewAnswer> select_view(const HeightBounds& bounds, const Recipe& recipe, const Camera& camera, const ViewOptions& options) {
  return Selection(bounds, recipe, camera, options).run();
}

Result<Camera> camera_from_world(const Layer& layer, const CameraPlace& place) {
  const LayerInfo& info = layer.info();
  Camera camera;
  camera.cell_x_m = info.cell_x_m;
  camera.cell_y_m = info.cell_y_m;
  const auto eye = info.post_from_world(info.base_level, place.eye[0], place.eye[1]);
  // The cell under the eye: lengths between neighbouring posts over the ellipsoid's local radii.
  const PostWindow& w = info.world;
  const double i = std::clamp(eye[0], static_cast<double>(w.i0), static_cast<double>(w.i1)), j = std::clamp(eye[1], static_cast<double>(w.j0), static_cast<double>(w.j1));
  std::array<double, 3> x{}, y{};
  for (int n = 0; n < 3; ++n) {
    const auto at = info.world_from_post(info.base_level, n == 1 ? i + 1 : i, n == 2 ? j + 1 : j);
    x[n] = at[0];
    y[n] = at[1];
  }
  std::array<bool, 3> ok{};
  layer.crs().wgs84_from_layer(x, y, ok);
  if (ok[0] && ok[1] && ok[2]) {
    constexpr double kMajor_m = 6378137, kEccentricity2 = 0.00669437999014, kDegree = 0.017453292519943295;
    const double s = std::sin(y[0] * kDegree), q = 1 - kEccentricity2 * s * s;
    const double east_m = kDegree * kMajor_m / std::sqrt(q) * std::cos(y[0] * kDegree), north_m = kDegree * kMajor_m * (1 - kEccentricity2) / (q * std::sqrt(q));
    const double cell_x_m = std::hypot((x[1] - x[0]) * east_m, (y[1] - y[0]) * north_m);
    const double cell_y_m = std::hypot((x[2] - x[0]) * east_m, (y[2] - y[0]) * north_m);
    if (cell_x_m > 0 && cell_y_m > 0) {
      camera.cell_x_m = cell_x_m;
      camera.cell_y_m = cell_y_m;
    }
  }
  const auto on_plane = [&](const std::array<double, 2>& post, double height_m) {
    const auto xy = plane_from_post(post[0], post[1], camera.cell_x_m, camera.cell_y_m);
    return Vec3{xy[0], xy[1], height_m};
  };
  camera.eye_m = on_plane(eye, place.eye[2]);
  Vec3 forward;
  if (place.has_target) {
    forward = minus(on_plane(info.post_from_world(info.base_level, place.look[0], place.look[1]), place.look[2]), camera.eye_m);
  } else {
    // Metres to the CRS' own units, axis by axis, then along the posts.
    const double ux = std::hypot(info.transform[1], info.transform[4]) / camera.cell_x_m, uy = std::hypot(info.transform[2], info.transform[5]) / camera.cell_y_m;
    const auto there = info.post_from_world(info.base_level, place.eye[0] + place.look[0] * ux, place.eye[1] + place.look[1] * uy);
    forward = {(there[0] - eye[0]) * camera.cell_x_m, -(there[1] - eye[1]) * camera.cell_y_m, place.look[2]};
  }
  const double length = std::sqrt(dot(forward, forward));
  if (!(length > 1e-9) || !std::isfinite(length)) {
    return Error{ErrorCode::kInvalidArgument, place.has_target ? "target: must not be the same place as eye" : "direction: must not be zero"};
  }
  camera.forward = scaled(forward, 1 / length);
  return camera;
}

}  // namespace lodestone
