#pragma once
// Front door of the Bitree: which posts of a tile are kept, the right-triangle hierarchy over them, its surface and its mesh.
// Source: Abasolo, "Wavelet Analysis for a New Multiresolution Model for Large-Scale Textured Terrains", sec. 3.
// Every function is pure: same arguments, same bytes, on every machine.
//
// The hierarchy. A tile of (2^n + 1)^2 posts starts as two right triangles that share the diagonal NW-SE. A triangle (apex, p, q) is
// split at the middle of its hypotenuse p-q into (m, apex, p) and (m, q, apex); so levels 0..2n-1 of split points hold every post but
// the corners. A post that is wanted (selected) needs both triangles on its hypotenuse; their apexes come into the mesh as fictitious
// points when nobody selected them, at the mean of their own hypotenuse's ends: they change connectivity, never the surface.

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "kernels/mesh/tin.h"
#include "kernels/types/result.h"
#include "kernels/types/tin_mesh.h"

namespace lodestone {

inline constexpr int kMaxBitreeN = 13;                        // 8193 posts a side
inline constexpr std::int32_t kMaxLatticeHeight = 1 << 26;    // |q| is below it, so that means of means are exact in double

enum class BitreeState : std::uint8_t { kNone, kSelected, kFictitious };

// Kept posts of one tile. Heights lie on a lattice: height = z_offset_m + z_step_m * q.
struct Bitree {
  int n = 0;                             // 2^n + 1 posts a side
  double z_offset_m = 0, z_step_m = 1;
  std::vector<BitreeState> state;        // side * side, row 0 north; corners are always selected
  std::vector<std::int32_t> q;           // side * side; meaningful where selected, 0 elsewhere
  std::size_t selected = 0, fictitious = 0;   // corners count as selected

  int side() const { return (1 << n) + 1; }
  std::size_t index(int row, int col) const { return static_cast<std::size_t>(row) * static_cast<std::size_t>(side()) + static_cast<std::size_t>(col); }
};

struct BitreeRequest {
  PostField field;                 // cols == rows == 2^n + 1, n in 1..13; the halo is not looked at
  double z_step_m = 1;             // quantisation of heights, > 0; a fictitious or interpolated post is not rounded
  double z_offset_m = 0;           // a multiple of z_step_m, the same for all tiles of a level
  // Wavelet rule: a group of posts shrinks to its north-west one when all its CDF(2,2) coefficients are at most threshold_m, metres.
  // No bound on the error follows.
  std::optional<double> threshold_m;
  int wavelet_levels = 4;          // groups reach 2^wavelet_levels posts; posts on multiples of that stay. 1..n (more is taken as n)
  // Bounded rule: no post is farther than this from the surface, quantisation included. Needs z_step_m <= 2 * max_error_m.
  std::optional<double> max_error_m;
  // Keeps every post: the shortest stream of a lossless tile (no states to tell), at the most triangles. The other rules are then idle.
  bool keeps_all = false;
  // At least one rule is given; with both tolerances, a post that either wants is kept.
  // Edge posts are chosen from the edge alone (midpoints that miss their parents' mean by more than the smaller of the two
  // tolerances, and in wavelet mode multiples of 2^wavelet_levels), so that neighbouring tiles have the same edge surface.
  // false: the wavelet rule as published, edges included.
  bool is_edge_shared = true;
};

// Errors: kInvalidArgument (side, step, tolerances, NaN heights, void posts: fill them first), kTooLarge (n, lattice height).
Result<Bitree> build_bitree(const BitreeRequest& request);

// Calls in the fictitious points that the selected ones need, drops those that they do not, and counts both. For points chosen by other
// rules: fill n, state, q and the lattice first; the corners become selected.
void close_bitree(Bitree& tree);

// Makes fictitious points real: takes their height from the field. The result is the mesh of a restricted quadtree (RTIN).
// The field is that of the request. Errors: kInvalidArgument for a field of another size.
Result<void> promote_fictitious(Bitree& tree, const PostField& field);

// The tree without the split points of levels >= level; level in 0..2n. Such a prefix is always a valid tree.
Bitree bitree_prefix(const Bitree& tree, int level);

// Surface at every post, metres, side * side, row 0 north.
std::vector<double> bitree_surface(const Bitree& tree);

struct BitreeError {
  double max_m = 0, rms_m = 0;         // over every post
  double max_normalised = 0, rms_normalised = 0;   // divided by the field's height range; 0 for a flat field
};
// Needs a field of the tree's size. Exact: no rasterisation (a triangle's interior posts are means of means of its corners).
BitreeError measure_bitree_error(const Bitree& tree, const PostField& field);

// Upper bounds of the error of every prefix: entry k = after the split points of levels 0..k-1 (2n + 1 entries, never rising, the
// last is error.max_m). A stream cut inside level k is covered by entry k. final_error_m: max_m of the whole tree.
std::vector<double> bitree_error_bounds(const Bitree& tree, double final_error_m);

// The leaves as a mesh: conforming, no degenerate triangle, counter-clockwise from above; triangles in Sierpinski order (neighbours
// in the list share an edge). Errors in the mesh are left 0: set them from measure_bitree_error.
TinMesh bitree_mesh(const Bitree& tree, std::int64_t i0 = 0, std::int64_t j0 = 0);

// One triangle strip over the mesh of bitree_mesh: indices of its vertices, first triangle counter-clockwise. Repeated indices make
// degenerate triangles where the strip turns.
std::vector<std::uint32_t> bitree_strip(const TinMesh& mesh);

// build_bitree, bitree_mesh and the measured errors in one: what `mesh=bitree` serves; with is_quadtree what `mesh=quadtree` serves.
Result<TinMesh> build_bitree_mesh(const BitreeRequest& request, std::int64_t i0 = 0, std::int64_t j0 = 0, bool is_quadtree = false);

}  // namespace lodestone
