#pragma once
// Borders of a zone map as simplified chains of grid nodes.
// Source: Suglobov, "Appearance-Preserving Terrain Simplification", sec. 4. Borders run along cell edges, so
// that every border vertex is a grid node (the paper joins centres of borderline pixels). Rule 3 is
// Douglas-Peucker per chain: the paper's repeated local test drifts.

#include <cstdint>
#include <span>
#include <vector>

#include "kernels/mesh/triangulation.h"
#include "kernels/types/tin_mesh.h"

namespace lodestone {

// Zone label of every cell between posts: cols * rows cells and `halo` more on every side, row 0 north.
// Labels as in TinMesh.
struct CellLabels {
  std::int32_t cols = 0, rows = 0;
  std::int32_t halo = 0;
  std::vector<std::uint16_t> labels;  // (cols + 2 halo) * (rows + 2 halo)

  // (col, row) may lie in the halo; beyond it the nearest cell counts.
  std::uint16_t at(std::int32_t col, std::int32_t row) const;
};

// Joins 4-connected regions of fewer than min_cells cells to the neighbour with the longest contact (ties:
// smaller id). Smallest region first; for a whole map, before tiles are cut from it.
void sieve_zones(CellLabels& map, std::int32_t min_cells);

// Cells whose centre is nearer than width + 0.5 to the centre of a cell of another zone become
// transition_zone(own, nearest other), ties to the smaller id. Needs width + 1 cells of halo to agree with
// neighbours in one cell of halo.
CellLabels with_transitions(const CellLabels& map, std::int32_t width);

// Share 0..1 of zone b at a post: dA / (dA + dB), distances to the nearest cell that is purely a or b within
// `reach` cells.
float transition_blend(const CellLabels& marked, std::int32_t col, std::int32_t row, int a, int b,
                       std::int32_t reach);

// A border between two zones from node to node; a free loop starts and ends at its smallest (row, col).
struct ZoneChain {
  std::vector<LatticePoint> points;
  std::uint16_t left = 0, right = 0;  // seen along the chain, north up
};

// Unit-step chains of the map, from the smaller end point, in order of their first points.
std::vector<ZoneChain> trace_zone_borders(const CellLabels& map);

// Rules 2 and 3: drops collinear points, then points nearer than epsilon to the segment that replaces them;
// epsilon halves for chains that would cross, touch or overlap another one, or lie on the tile edge (below
// 0.1: collinear points only). Chains beside exact_label lose collinear points only (0xffff: none is).
std::vector<ZoneChain> simplify_zone_borders(const std::vector<ZoneChain>& unit_chains, std::int32_t cols,
                                             std::int32_t rows, double epsilon, std::uint16_t exact_label);

// Posts of the tile's edge where a zone border leaves the tile: the two cells on this side of the edge or the
// two on the other differ. One flag per post of the edge. along_rows: the edge is the column `at`, else the
// row `at`.
std::vector<std::uint8_t> required_edge_posts(const CellLabels& map, bool along_rows, std::int32_t at);

}  // namespace lodestone
