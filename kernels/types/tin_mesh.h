#pragma once
// TinMesh: a triangle mesh over a rectangle of posts, with what is known about its quality.

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace lodestone {

// A mesh vertex; (col, row) is its post, counted from the north-west post of the mesh, east and south.
struct TinVertex {
  std::int32_t col = 0;
  std::int32_t row = 0;
  float height_m = 0;
  bool operator==(const TinVertex&) const = default;
};

// Zone ids of triangles. 0..127 are the ids of the zone map; transition strips carry both of their zones.
inline constexpr std::uint16_t kMaxZone = 127;
inline constexpr std::uint16_t kTransitionFlag = 0x8000;
inline std::uint16_t transition_zone(int a, int b) {
  return static_cast<std::uint16_t>(kTransitionFlag + 128 * std::min(a, b) + std::max(a, b));
}
inline bool is_transition(std::uint16_t zone) { return (zone & kTransitionFlag) != 0; }
inline int first_zone(std::uint16_t zone) { return is_transition(zone) ? (zone & 0x7fff) >> 7 : zone; }
inline int second_zone(std::uint16_t zone) { return is_transition(zone) ? zone & 0x7f : zone; }

struct TinMesh {
  std::int32_t cols = 0, rows = 0;  // posts covered, both at least 2
  std::int64_t i0 = 0, j0 = 0;      // global index of the north-west post on its level

  std::vector<TinVertex> vertices;
  std::vector<std::uint32_t> triangles;  // 3 per triangle, counter-clockwise seen from above with north up
  std::vector<std::uint16_t> zones;      // one per triangle, or empty
  std::vector<float> blend;    // 3 per triangle: share 0..1 of second_zone() at its corners; or empty
  std::vector<float> normals;  // 3 per vertex: east, north, up, unit length; or empty

  // Vertices and triangles from these indices on are skirt; the top surface comes first.
  std::size_t top_vertices = 0, top_triangles = 0;
  float skirt_depth_m = 0;

  double max_error_m = 0;  // measured over every counted post: |surface - height|
  double rms_error_m = 0;

  std::size_t vertex_count() const { return vertices.size(); }
  std::size_t triangle_count() const { return triangles.size() / 3; }
};

// Top vertices on each side of the mesh. west and east run from the south end, south and north from the west
// end.
struct TinBorder {
  std::vector<std::uint32_t> west, south, east, north;
};

inline TinBorder border_of(const TinMesh& mesh) {
  TinBorder border;
  for (std::uint32_t v = 0; v < mesh.top_vertices; ++v) {
    const TinVertex& p = mesh.vertices[v];
    if (p.col == 0) border.west.push_back(v);
    if (p.col == mesh.cols - 1) border.east.push_back(v);
    if (p.row == 0) border.north.push_back(v);
    if (p.row == mesh.rows - 1) border.south.push_back(v);
  }
  const auto northwards = [&](std::uint32_t a, std::uint32_t b) {
    return mesh.vertices[a].row > mesh.vertices[b].row;
  };
  const auto eastwards = [&](std::uint32_t a, std::uint32_t b) {
    return mesh.vertices[a].col < mesh.vertices[b].col;
  };
  std::sort(border.west.begin(), border.west.end(), northwards);
  std::sort(border.east.begin(), border.east.end(), northwards);
  std::sort(border.south.begin(), border.south.end(), eastwards);
  std::sort(border.north.begin(), border.north.end(), eastwards);
  return border;
}

// Lowest and highest top vertex, metres. Needs at least one top vertex.
inline std::array<float, 2> height_range(const TinMesh& mesh) {
  std::array<float, 2> range{mesh.vertices[0].height_m, mesh.vertices[0].height_m};
  for (std::size_t v = 0; v < mesh.top_vertices; ++v) {
    range[0] = std::min(range[0], mesh.vertices[v].height_m);
    range[1] = std::max(range[1], mesh.vertices[v].height_m);
  }
  return range;
}

}  // namespace lodestone
