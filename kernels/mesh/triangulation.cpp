#include "kernels/mesh/triangulation.h"

#include <cassert>
#include <deque>

namespace lodestone {

std::int64_t in_circle(const LatticePoint& a, const LatticePoint& b, const LatticePoint& c,
                       const LatticePoint& d) {
  const std::int64_t ax = a.col - d.col, ay = d.row - a.row;
  const std::int64_t bx = b.col - d.col, by = d.row - b.row;
  const std::int64_t cx = c.col - d.col, cy = d.row - c.row;
  return (ax * ax + ay * ay) * (bx * cy - by * cx) - (bx * bx + by * by) * (ax * cy - ay * cx) +
         (cx * cx + cy * cy) * (ax * by - ay * bx);
}

Triangulation::Triangulation(std::int32_t cols, std::int32_t rows) {
  points_ = {{0, 0}, {cols - 1, 0}, {cols - 1, rows - 1}, {0, rows - 1}};
  outgoing_.assign(4, kNone);
  add_triangle();
  add_triangle();
  // NW, SW, SE and NW, SE, NE share the diagonal NW-SE.
  set(0, 0, kNone, kNone);
  set(1, 3, kNone, kNone);
  set(2, 2, 3, kNone);
  set(3, 0, 2, kNone);
  set(4, 2, kNone, kNone);
  set(5, 1, kNone, kNone);
}

void Triangulation::set(std::int32_t e, std::int32_t origin, std::int32_t twin, std::int32_t constraint) {
  const auto at = static_cast<std::size_t>(e);
  origin_[at] = origin;
  twin_[at] = twin;
  constraint_[at] = constraint;
  outgoing_[static_cast<std::size_t>(origin)] = e;
  if (twin != kNone) twin_[static_cast<std::size_t>(twin)] = e;
}

std::int32_t Triangulation::add_triangle() {
  const auto t = static_cast<std::int32_t>(triangle_count());
  origin_.resize(origin_.size() + 3, kNone);
  twin_.resize(twin_.size() + 3, kNone);
  constraint_.resize(constraint_.size() + 3, kNone);
  return t;
}

std::int32_t Triangulation::locate(const LatticePoint& p, std::int32_t start) const {
  std::int32_t t = start;
  std::int32_t came_from = kNone;
  // A visibility walk may cycle on triangulations that are not Delaunay; the scan behind it always ends.
  for (std::size_t steps = 0; steps < 4 * triangle_count() + 16; ++steps) {
    bool has_moved = false;
    for (int i = 0; i < 3; ++i) {
      const std::int32_t e = 3 * t + static_cast<std::int32_t>((i + steps) % 3);
      if (e == came_from) continue;
      if (orient(point(origin(e)), point(destination(e)), p) < 0 && twin(e) != kNone) {
        came_from = twin(e);
        t = came_from / 3;
        has_moved = true;
        break;
      }
    }
    if (!has_moved) return t;
  }
  for (t = 0; t < static_cast<std::int32_t>(triangle_count()); ++t) {
    bool is_inside = true;
    for (std::int32_t e = 3 * t; e < 3 * t + 3; ++e) {
      is_inside = is_inside && orient(point(origin(e)), point(destination(e)), p) >= 0;
    }
    if (is_inside) return t;
  }
  assert(false && "locate: the point is outside the rectangle");
  return 0;
}

std::int32_t Triangulation::insert_inside(std::int32_t t, const LatticePoint& p) {
  const auto v = static_cast<std::int32_t>(points_.size());
  points_.push_back(p);
  outgoing_.push_back(kNone);
  const std::int32_t e0 = 3 * t, e1 = e0 + 1, e2 = e0 + 2;
  const std::int32_t a = origin(e0), b = origin(e1), c = origin(e2);
  const std::int32_t tb = twin(e1), tc = twin(e2), kb = constraint(e1), kc = constraint(e2);
  const std::int32_t u = add_triangle(), w = add_triangle();
  // (a, b, v) stays t; (b, c, v) is u; (c, a, v) is w.
  set(3 * u, b, tb, kb);
  set(3 * w, c, tc, kc);
  set(e1, b, 3 * u + 2, kNone);
  set(3 * u + 1, c, 3 * w + 2, kNone);
  set(3 * w + 1, a, e2, kNone);
  set(e2, v, 3 * w + 1, kNone);
  set(3 * u + 2, v, e1, kNone);
  set(3 * w + 2, v, 3 * u + 1, kNone);
  touched_.insert(touched_.end(), {t, u, w});
  return v;
}

std::int32_t Triangulation::insert_on_edge(std::int32_t e, const LatticePoint& p) {
  const auto v = static_cast<std::int32_t>(points_.size());
  points_.push_back(p);
  outgoing_.push_back(kNone);
  const std::int32_t f = twin(e);
  const std::int32_t k = constraint(e);
  const std::int32_t b = destination(e), l = apex(e);

  // Near side, e = a -> b with apex l: (a, v, l) stays, (v, b, l) is new.
  const std::int32_t t = e / 3;
  const std::int32_t en = next(e);
  const std::int32_t near_twin = twin(en), near_constraint = constraint(en);
  const std::int32_t u = add_triangle();
  set(3 * u, v, kNone, k);
  set(3 * u + 1, b, near_twin, near_constraint);
  set(3 * u + 2, l, en, kNone);
  set(en, v, 3 * u + 2, kNone);
  touched_.insert(touched_.end(), {t, u});
  if (f == kNone) return v;

  // Far side, f = b -> a with apex r: (v, a, r) stays, (b, v, r) is new.
  const std::int32_t s = f / 3;
  const std::int32_t fp = prev(f);
  const std::int32_t r = origin(fp);
  const std::int32_t far_twin = twin(fp), far_constraint = constraint(fp);
  const std::int32_t w = add_triangle();
  const std::int32_t kf = constraint(f);
  set(3 * w, b, 3 * u, kf);
  set(3 * w + 1, v, fp, kNone);
  set(3 * w + 2, r, far_twin, far_constraint);
  set(f, v, e, kf);
  set(fp, r, 3 * w + 1, kNone);
  touched_.insert(touched_.end(), {s, w});
  return v;
}

bool Triangulation::is_flippable(std::int32_t e) const {
  const LatticePoint& b = point(origin(e));
  const LatticePoint& d = point(destination(e));
  const LatticePoint& a = point(apex(e));
  const LatticePoint& c = point(apex(twin(e)));
  return orient(a, b, c) > 0 && orient(a, c, d) > 0;
}

void Triangulation::flip(std::int32_t e) {
  const std::int32_t f = twin(e);
  const std::int32_t t = e / 3, u = f / 3;
  const std::int32_t b = origin(e), d = origin(f), a = apex(e), c = apex(f);
  const std::int32_t ab = prev(e), da = next(e), bc = next(f), cd = prev(f);
  const std::int32_t t_ab = twin(ab), t_da = twin(da), t_bc = twin(bc), t_cd = twin(cd);
  const std::int32_t k_ab = constraint(ab), k_da = constraint(da), k_bc = constraint(bc),
                     k_cd = constraint(cd);
  set(3 * t, a, t_ab, k_ab);
  set(3 * t + 1, b, t_bc, k_bc);
  set(3 * t + 2, c, 3 * u, kNone);
  set(3 * u, a, 3 * t + 2, kNone);
  set(3 * u + 1, c, t_cd, k_cd);
  set(3 * u + 2, d, t_da, k_da);
  touched_.insert(touched_.end(), {t, u});
}

void Triangulation::legalize_delaunay(std::int32_t vertex, std::vector<std::int32_t>& stack) {
  while (!stack.empty()) {
    const std::int32_t e = stack.back();
    stack.pop_back();
    if (is_fixed(e) || apex(e) != vertex) continue;
    const std::int32_t far = apex(twin(e));
    if (in_circle(point(origin(e)), point(destination(e)), point(vertex), point(far)) <= 0) continue;
    const std::int32_t t = e / 3, u = twin(e) / 3;
    flip(e);
    stack.push_back(3 * u + 1);
    stack.push_back(3 * t + 1);
  }
}

template <class Visit>
void Triangulation::for_each_outgoing(std::int32_t v, Visit&& visit) const {
  const std::int32_t start = outgoing_[static_cast<std::size_t>(v)];
  std::int32_t e = start;
  do {  // counter-clockwise
    if (!visit(e)) return;
    e = twin(prev(e));
  } while (e != kNone && e != start);
  if (e == start) return;
  for (e = start; twin(e) != kNone;) {  // then clockwise from the start to the other tile edge
    e = next(twin(e));
    if (!visit(e)) return;
  }
}

std::int32_t Triangulation::add_delaunay(const LatticePoint& p, std::int32_t& hint) {
  const std::int32_t t = locate(p, hint);
  hint = t;
  std::int32_t on_edge = kNone;
  for (std::int32_t e = 3 * t; e < 3 * t + 3; ++e) {
    if (point(origin(e)) == p) return origin(e);
    if (orient(point(origin(e)), point(destination(e)), p) == 0) on_edge = e;
  }
  const std::int32_t v = on_edge == kNone ? insert_inside(t, p) : insert_on_edge(on_edge, p);
  std::vector<std::int32_t> stack;
  for_each_outgoing(v, [&](std::int32_t e) {
    stack.push_back(next(e));
    return true;
  });
  legalize_delaunay(v, stack);
  return v;
}

std::int32_t Triangulation::find_edge(std::int32_t u, std::int32_t v) const {
  std::int32_t found = kNone;
  for_each_outgoing(u, [&](std::int32_t e) {
    if (destination(e) == v) found = e;
    if (apex(e) == v && twin(prev(e)) == kNone) found = prev(e);  // only v -> u exists, on the tile edge
    return found == kNone;
  });
  return found;
}

bool Triangulation::add_constraint(std::int32_t u, std::int32_t v, std::int32_t id) {
  const LatticePoint pu = point(u), pv = point(v);
  if (std::int32_t e = find_edge(u, v); e == kNone) {
    // Edges that cross u-v, from the triangle at u on.
    std::deque<std::pair<std::int32_t, std::int32_t>> crossing;
    std::int32_t first = kNone;
    for_each_outgoing(u, [&](std::int32_t o) {
      const std::int32_t across = next(o);
      if (orient(pu, pv, point(origin(across))) < 0 && orient(pu, pv, point(destination(across))) > 0)
        first = across;
      return first == kNone;
    });
    if (first == kNone || is_fixed(first)) return false;
    for (std::int32_t x = first;;) {
      crossing.emplace_back(origin(x), destination(x));
      const std::int32_t y = twin(x);
      const std::int32_t far = apex(y);
      if (far == v) break;
      const std::int64_t side = orient(pu, pv, point(far));
      if (side == 0) return false;
      x = side > 0 ? next(y) : prev(y);
      if (is_fixed(x)) return false;
    }
    const auto crosses = [&](std::int32_t a, std::int32_t b) {
      if (a == u || a == v || b == u || b == v) return false;
      const std::int64_t sa = orient(pu, pv, point(a)), sb = orient(pu, pv, point(b));
      return (sa > 0) != (sb > 0);
    };
    while (!crossing.empty()) {
      const auto [a, b] = crossing.front();
      crossing.pop_front();
      e = find_edge(a, b);
      if (!is_flippable(e)) {
        crossing.emplace_back(a, b);
        continue;
      }
      const std::int32_t pa = apex(e), pc = apex(twin(e));
      flip(e);
      if (crosses(pa, pc)) crossing.emplace_back(pa, pc);
    }
  }
  const std::int32_t e = find_edge(u, v);
  assert(e != kNone && "add_constraint: the edge is there after the swaps");
  if (constraint(e) != kNone || twin(e) == kNone) return false;
  constraint_[static_cast<std::size_t>(e)] = id;
  constraint_[static_cast<std::size_t>(twin(e))] = id;
  return true;
}

void Triangulation::relax() {
  bool has_changed = true;
  while (has_changed) {
    has_changed = false;
    for (std::int32_t e = 0; e < static_cast<std::int32_t>(origin_.size()); ++e) {
      if (is_fixed(e) || e > twin(e)) continue;
      if (in_circle(point(origin(e)), point(destination(e)), point(apex(e)), point(apex(twin(e)))) <= 0)
        continue;
      flip(e);
      has_changed = true;
    }
  }
}

}  // namespace lodestone
