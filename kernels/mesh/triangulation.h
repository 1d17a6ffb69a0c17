#pragma once
// Triangulation: triangles with half-edges over integer points, exact predicates, constrained edges.
// Half-edge e = 3 t + i runs from origin(e) to destination(e) along triangle t's border, counter-clockwise
// seen from above with north up. Points are (col, row) with row growing south.

#include <cstddef>
#include <cstdint>
#include <vector>

namespace lodestone {

struct LatticePoint {
  std::int32_t col = 0, row = 0;
  bool operator==(const LatticePoint&) const = default;
};

// Twice the signed area of abc: > 0 counter-clockwise seen from above with north up. Exact.
inline std::int64_t orient(const LatticePoint& a, const LatticePoint& b, const LatticePoint& c) {
  return static_cast<std::int64_t>(b.row - a.row) * (c.col - a.col) -
         static_cast<std::int64_t>(b.col - a.col) * (c.row - a.row);
}
// > 0 when d lies strictly inside the circle through a, b, c (counter-clockwise). Exact for coordinates up to
// 8192.
std::int64_t in_circle(const LatticePoint& a, const LatticePoint& b, const LatticePoint& c,
                       const LatticePoint& d);

class Triangulation {
 public:
  static constexpr std::int32_t kNone = -1;

  // Two triangles over the rectangle of posts [0, cols) x [0, rows); vertices 0..3 are NW, NE, SE, SW.
  Triangulation(std::int32_t cols, std::int32_t rows);

  std::size_t triangle_count() const { return origin_.size() / 3; }
  std::size_t vertex_count() const { return points_.size(); }
  const LatticePoint& point(std::int32_t v) const { return points_[static_cast<std::size_t>(v)]; }

  static std::int32_t next(std::int32_t e) { return e % 3 == 2 ? e - 2 : e + 1; }
  static std::int32_t prev(std::int32_t e) { return e % 3 == 0 ? e + 2 : e - 1; }
  std::int32_t origin(std::int32_t e) const { return origin_[static_cast<std::size_t>(e)]; }
  std::int32_t destination(std::int32_t e) const { return origin(next(e)); }
  std::int32_t apex(std::int32_t e) const { return origin(prev(e)); }
  std::int32_t twin(std::int32_t e) const {
    return twin_[static_cast<std::size_t>(e)];
  }  // kNone on the tile edge
  // Constraint that the edge lies on, or kNone when it may be swapped. Tile edges have no twin and no
  // constraint.
  std::int32_t constraint(std::int32_t e) const { return constraint_[static_cast<std::size_t>(e)]; }
  bool is_fixed(std::int32_t e) const { return twin(e) == kNone || constraint(e) != kNone; }

  // A triangle that contains p in its closed interior. p must lie inside the rectangle.
  std::int32_t locate(const LatticePoint& p, std::int32_t start) const;

  // New vertex strictly inside triangle t: t and two new triangles, t keeps its index. Returns the vertex.
  std::int32_t insert_inside(std::int32_t t, const LatticePoint& p);
  // New vertex on edge e, or beside it when the caller knows that all new triangles stay positive: the edge
  // a-b becomes a-p-b and both halves inherit its constraint. Returns the vertex.
  std::int32_t insert_on_edge(std::int32_t e, const LatticePoint& p);
  // Swaps the diagonal of the two triangles beside e = b -> d with apex a and far vertex c. Afterwards
  // triangle(e) is (a, b, c), the other (a, c, d), each starting at a.
  void flip(std::int32_t e);
  // Is the quadrilateral around e strictly convex?
  bool is_flippable(std::int32_t e) const;

  // Inserts p with Delaunay swaps, starting the walk at `hint` (updated). Returns its vertex, the old one if
  // p is there already.
  std::int32_t add_delaunay(const LatticePoint& p, std::int32_t& hint);
  // Makes u-v an edge and marks it as lying on `constraint`. Fails (false) when a vertex or a constrained
  // edge is in the way.
  bool add_constraint(std::int32_t u, std::int32_t v, std::int32_t constraint);
  // Swaps free edges until every one is locally Delaunay.
  void relax();

  // Triangles changed since the last clear_touched(), possibly repeated.
  const std::vector<std::int32_t>& touched() const { return touched_; }
  void clear_touched() { touched_.clear(); }

 private:
  void set(std::int32_t e, std::int32_t origin, std::int32_t twin, std::int32_t constraint);
  std::int32_t add_triangle();
  std::int32_t find_edge(std::int32_t u, std::int32_t v) const;
  void legalize_delaunay(std::int32_t vertex, std::vector<std::int32_t>& stack);
  template <class Visit>
  void for_each_outgoing(std::int32_t v, Visit&& visit) const;

  std::vector<LatticePoint> points_;
  std::vector<std::int32_t> origin_, twin_, constraint_;  // per half-edge
  std::vector<std::int32_t> outgoing_;                    // per vertex, one half-edge that starts there
  std::vector<std::int32_t> touched_;
};

}  // namespace lodestone
