#pragma once
// Front door of the terrain meshes: greedy TIN with zone borders, regular grid, skirts, normals, measured
// errors. Source: Suglobov, "Appearance-Preserving Terrain Simplification", sec. 4-6, on Garland & Heckbert's
// greedy insertion, algorithm IV (data-dependent triangulation). Every function is pure: same arguments, same
// bytes, on every machine.

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

#include "kernels/types/result.h"
#include "kernels/types/tin_mesh.h"

namespace lodestone {

// Heights of a rectangle of posts with `halo` more on every side: (cols + 2 halo) * (rows + 2 halo) finite
// float32 metres, row 0 north. is_void: empty, or one byte per height, 1 = void. The memory stays the
// caller's.
struct PostField {
  std::span<const float> heights_m;
  std::span<const std::uint8_t> is_void;
  std::int32_t cols = 0, rows = 0;
  std::int32_t halo = 0;

  std::size_t index(std::int32_t col, std::int32_t row) const {
    return static_cast<std::size_t>(row + halo) * static_cast<std::size_t>(cols + 2 * halo) +
           static_cast<std::size_t>(col + halo);
  }
  float at(std::int32_t col, std::int32_t row) const { return heights_m[index(col, row)]; }
  bool void_at(std::int32_t col, std::int32_t row) const {
    return !is_void.empty() && is_void[index(col, row)] != 0;
  }
};

// Zone ids 0..kMaxZone of the cells between posts: (cols - 1 + 2 halo) * (rows - 1 + 2 halo), row 0 north.
// halo >= 1 makes neighbouring tiles agree on border vertices; transitions need transition_cells + 1, and 3
// transition_cells + 3 for equal blend weights along shared edges.
struct ZoneField {
  std::span<const std::uint16_t> labels;
  std::int32_t halo = 0;
  double epsilon_cells = 0.75;  // how far a simplified border may lie from the true one; 0 = exact
  double tie_cells = 0.5;  // how far a border may be moved to a post that is inserted beside it; 0 = never
  std::int32_t transition_cells = 0;  // half width of the strips between zones; 0 = none
};

enum class TinCriterion : std::uint8_t { kDataDependent, kDelaunay };
enum class TinVoids : std::uint8_t { kFill, kHole };  // kHole: cells that touch a void post have no triangles

struct TinRequest {
  PostField field;
  std::int64_t i0 = 0, j0 = 0;        // global index of the north-west post
  std::optional<double> max_error_m;  // stop when no post is farther than this from the surface
  std::optional<std::size_t>
      max_triangles;  // stop before more top triangles than this; at least one of the two is set
  std::optional<double>
      edge_error_m;  // bound along the tile's edges; default max_error_m. The same for neighbours.
  TinCriterion criterion = TinCriterion::kDataDependent;
  TinVoids voids = TinVoids::kFill;
  std::optional<ZoneField> zones;
};

// Greedy insertion TIN. The tile's edges are chosen first, from edge posts alone (8.2 of the method: 1-D
// Douglas-Peucker from the north or west end), so that neighbours with the same heights, edge bound and zone
// labels get identical border vertices at any bound or budget. Inside, the post with the largest error goes
// in first (ties: first in row-major order of global index). With a bound E: measured max_error_m <= E, save
// for rounding in the last bit. With a budget: never worse in maximum error than any prefix of the
// insertions; the border and zone vertices are kept even when they alone exceed the budget. Cells: at most
// 8192 a side. Errors: kInvalidArgument (sizes, NaN, bounds, zone ids), kTooLarge.
Result<TinMesh> build_tin(const TinRequest& request);

// Every step-th post, two triangles a cell (diagonal NW-SE). step divides cols - 1 and rows - 1. Errors:
// kInvalidArgument.
Result<TinMesh> build_grid_mesh(const PostField& field, std::int64_t i0, std::int64_t j0, std::int32_t step);

struct SurfaceError {
  double max_m = 0, rms_m = 0;
  std::size_t posts = 0;  // counted: covered by a top triangle and not void
};
// Height difference between the top surface and the posts, every post once.
SurfaceError measure_error(const TinMesh& mesh, const PostField& field);

// Normals of the height field (not of the triangles) by central differences; with halo >= 1 equal on shared
// edges of neighbours. spacing: metres between posts east and south, > 0.
void set_normals(TinMesh& mesh, const PostField& field, double spacing_x_m, double spacing_y_m);

// Quads that hang depth_m below the mesh's edges on the tile border, facing outwards. Never changes the top
// surface. Once per mesh.
void add_skirt(TinMesh& mesh, float depth_m);

// A depth that hides the cracks towards a neighbour whose own error is at most `neighbour_error_m`.
float skirt_depth_m(const TinMesh& mesh, double neighbour_error_m);

}  // namespace lodestone
