#pragma once
// Roughness of the quadtree nodes of real terrain: sigma and H of each, and the deviations that follow for
// every new level. Sources: Hu & Wang step 2 (the paper's increments replaced by second differences, which
// ignore planar slopes); SPEC-SYNTHESIS 5.1, 5.2, 6.4. Double arithmetic with our own logarithm and power:
// the same bits on every machine.

#include <cstdint>
#include <vector>

#include "kernels/types/height_grid.h"
#include "kernels/types/post_window.h"

namespace lodestone {

// Residuals of the node obey E r(tau)^2 = sigma^2 tau^2H, tau in data cells. Stored as they are.
struct NodeRoughness {
  float sigma_m = 0;  // deviation at tau = 1, metres; 0 on flat ground and where there is no data
  float h = 0.8F;     // 0.05 .. 1.9
  bool operator==(const NodeRoughness&) const = default;
};

// A rectangle of the layer's nodes, row-major. Node (0, 0) has its north-west corner on the north-west data
// post; each spans 2^node_log2 cells, the last ones may be cut off by the world.
struct NodeCrop {
  int node_log2 = 4;
  std::int64_t i0 = 0, j0 = 0;
  int width = 0, height = 0;
  std::int64_t layer_width = 0, layer_height = 0;  // nodes of the whole layer
  std::vector<NodeRoughness> nodes;
};

inline constexpr int kMaxNodeLog2 = 7;

// Nodes of the whole layer, {0, 0, width - 1, height - 1}.
PostWindow layer_nodes(const PostWindow& world, int node_log2);

// Posts that estimate_nodes() reads for `nodes`: the closed nodes and four posts around, clamped to the
// world.
PostWindow node_heights_window(const PostWindow& nodes, const PostWindow& world, int node_log2);

// sigma and H of each node of `nodes`. heights must cover node_heights_window(); residuals that touch a void
// are left out. A node depends on the world's heights only, never on the rectangle asked for.
NodeCrop estimate_nodes(const HeightGrid& heights, const PostWindow& world, const PostWindow& nodes,
                        int node_log2);

// Which predictor the displacement is added to.
enum class NodeKind : std::uint8_t { kSquare, kDiamondCentre, kDiamondEdge, kWaveletCentre, kWaveletEdge };

// rho(H) of SPEC-SYNTHESIS 5.2: residual of fBm under the predictor, relative to that of a segment's
// midpoint; H limited to 0.95. 1 for the fractal wavelet.
double predictor_ratio(double h, NodeKind kind);

// Deviation of the displacements that lead from level s = n - 1 to s + 1 = n below the data (n >= 1), metres.
// Midpoint methods sigma 2^(-nH) rho(H); fractal wavelet sigma tau^H, tau = 2^-(n - 1/2) for centres, 2^-n
// for edges.
float node_deviation(const NodeRoughness& node, int n, NodeKind kind);

}  // namespace lodestone
