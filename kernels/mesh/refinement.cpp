#include "kernels/mesh/refinement.h"

#include <algorithm>
#include <limits>

namespace lodestone {
namespace {

// Shape of a triangle: area over the square of its longest edge (times 2).
double quality(const LatticePoint& a, const LatticePoint& b, const LatticePoint& c) {
  const auto length2 = [](const LatticePoint& p, const LatticePoint& q) {
    const std::int64_t dx = q.col - p.col, dy = q.row - p.row;
    return dx * dx + dy * dy;
  };
  return static_cast<double>(orient(a, b, c)) /
         static_cast<double>(std::max({length2(a, b), length2(b, c), length2(c, a)}));
}

// Diagonals whose shapes are this similar are told apart by their errors.
constexpr double kSimilarShape = 0.5;

struct Foot {
  std::int64_t cross, along, length2;
};
Foot foot_on(const LatticePoint& p, const LatticePoint& a, const LatticePoint& b) {
  const std::int64_t dx = b.col - a.col, dy = b.row - a.row, px = p.col - a.col, py = p.row - a.row;
  return {px * dy - py * dx, px * dx + py * dy, dx * dx + dy * dy};
}
// Squared distance from p to the segment a-b.
double segment_distance2(const LatticePoint& p, const LatticePoint& a, const LatticePoint& b) {
  const Foot f = foot_on(p, a, b);
  if (f.along <= 0 || f.along >= f.length2) {
    const LatticePoint& end = f.along <= 0 ? a : b;
    const std::int64_t dx = p.col - end.col, dy = p.row - end.row;
    return static_cast<double>(dx * dx + dy * dy);
  }
  return static_cast<double>(f.cross) * static_cast<double>(f.cross) / static_cast<double>(f.length2);
}

}  // namespace

Refinement::Refinement(Triangulation& mesh, std::span<const float> heights_m, std::span<float> work_m,
                       std::int32_t cols, std::span<const BorderSegment> segments,
                       std::vector<std::uint16_t>& zone, TinCriterion criterion, double tie_cells)
    : mesh_(mesh),
      heights_m_(heights_m),
      work_m_(work_m),
      cols_(cols),
      segments_(segments),
      zone_(zone),
      criterion_(criterion),
      tie_cells_(tie_cells),
      field_{work_m.data(), cols} {}

ScanPoint Refinement::scan_point(std::int32_t v) const {
  const LatticePoint& p = mesh_.point(v);
  return {p.col, p.row,
          heights_m_[static_cast<std::size_t>(p.row) * static_cast<std::size_t>(cols_) +
                     static_cast<std::size_t>(p.col)]};
}

ScanResult Refinement::scan(std::int32_t a, std::int32_t b, std::int32_t c) const {
  return scan_triangle(field_, scan_point(a), scan_point(b), scan_point(c));
}

void Refinement::store(std::int32_t t, const ScanResult& result) {
  sites_[static_cast<std::size_t>(t)] = {result.error_m, result.sum2_m2,
                                         result.col < 0 ? -1 : result.row * cols_ + result.col, true};
}

const Refinement::Site& Refinement::site(std::int32_t t) {
  if (!sites_[static_cast<std::size_t>(t)].is_fresh) {
    store(t, scan(mesh_.origin(3 * t), mesh_.origin(3 * t + 1), mesh_.origin(3 * t + 2)));
  }
  return sites_[static_cast<std::size_t>(t)];
}

void Refinement::mark_stale(std::size_t first_touched) {
  sites_.resize(mesh_.triangle_count());
  heap_at_.resize(mesh_.triangle_count(), -1);
  for (std::size_t i = first_touched; i < mesh_.touched().size(); ++i) {
    sites_[static_cast<std::size_t>(mesh_.touched()[i])].is_fresh = false;
  }
}

// The constrained edge of t that p, strictly inside t, is tied to, or kNone. The paper's corrected snap: the
// edge comes to the post; measured against the original segment, so that a border cannot drift.
std::int32_t Refinement::tied_edge(std::int32_t t, const LatticePoint& p) const {
  std::int32_t best = Triangulation::kNone;
  double best_d2 = tie_cells_ * tie_cells_;
  for (std::int32_t e = 3 * t; e < 3 * t + 3; ++e) {
    if (mesh_.constraint(e) == Triangulation::kNone) continue;
    const BorderSegment& segment = segments_[static_cast<std::size_t>(mesh_.constraint(e))];
    if (!segment.is_tied) continue;
    const LatticePoint& a = mesh_.point(mesh_.origin(e));
    const LatticePoint& b = mesh_.point(mesh_.destination(e));
    const LatticePoint& r = mesh_.point(mesh_.apex(mesh_.twin(e)));
    const Foot f = foot_on(p, a, b);
    if (f.along <= 0 || f.along >= f.length2) continue;
    const double d2 =
        static_cast<double>(f.cross) * static_cast<double>(f.cross) / static_cast<double>(f.length2);
    if (d2 >= best_d2 || segment_distance2(p, segment.a, segment.b) >= tie_cells_ * tie_cells_) continue;
    if (orient(p, a, r) <= 0 || orient(b, p, r) <= 0) continue;
    best = e;
    best_d2 = d2;
  }
  return best;
}

void Refinement::insert(std::int32_t t, const LatticePoint& p) {
  std::int32_t edge = Triangulation::kNone;
  for (std::int32_t e = 3 * t; e < 3 * t + 3; ++e) {
    if (orient(mesh_.point(mesh_.origin(e)), mesh_.point(mesh_.destination(e)), p) == 0) edge = e;
  }
  if (edge == Triangulation::kNone && tie_cells_ > 0 && !segments_.empty()) edge = tied_edge(t, p);
  work_m_[static_cast<std::size_t>(p.row) * static_cast<std::size_t>(cols_) +
          static_cast<std::size_t>(p.col)] = std::numeric_limits<float>::quiet_NaN();
  std::int32_t v = 0;
  if (edge == Triangulation::kNone) {
    v = mesh_.insert_inside(t, p);
    if (!zone_.empty()) zone_.insert(zone_.end(), 2, zone_[static_cast<std::size_t>(t)]);
  } else {
    const std::int32_t far = mesh_.twin(edge);
    v = mesh_.insert_on_edge(edge, p);
    if (!zone_.empty()) {
      zone_.push_back(zone_[static_cast<std::size_t>(t)]);
      if (far != Triangulation::kNone) zone_.push_back(zone_[static_cast<std::size_t>(far / 3)]);
    }
  }
  mark_stale(0);
  legalize(v);
}

void Refinement::legalize(std::int32_t vertex) {
  stack_.clear();
  const std::size_t around = mesh_.touched().size();
  for (std::size_t i = around; i-- > 0;) {
    const std::int32_t t = mesh_.touched()[i];
    for (std::int32_t e = 3 * t; e < 3 * t + 3; ++e) {
      if (mesh_.apex(e) == vertex) stack_.push_back(e);
    }
  }
  while (!stack_.empty()) {
    const std::int32_t e = stack_.back();
    stack_.pop_back();
    if (mesh_.is_fixed(e) || mesh_.apex(e) != vertex) continue;
    const std::int32_t u = mesh_.twin(e) / 3;
    if (!try_swap(e)) continue;
    stack_.push_back(3 * u + 1);
    stack_.push_back(3 * (e / 3) + 1);
  }
}

bool Refinement::try_swap(std::int32_t e) {
  const std::int32_t a = mesh_.apex(e), b = mesh_.origin(e), d = mesh_.destination(e),
                     c = mesh_.apex(mesh_.twin(e));
  const std::int32_t t = e / 3, u = mesh_.twin(e) / 3;
  const LatticePoint &pa = mesh_.point(a), &pb = mesh_.point(b), &pc = mesh_.point(c), &pd = mesh_.point(d);
  if (criterion_ == TinCriterion::kDelaunay) {
    if (in_circle(pb, pd, pa, pc) <= 0) return false;
    const std::size_t before = mesh_.touched().size();
    mesh_.flip(e);
    mark_stale(before);
    return true;
  }
  if (!mesh_.is_flippable(e)) return false;
  const double kept = quality(pb, pd, pa) * quality(pd, pb, pc);
  const double swapped = quality(pa, pb, pc) * quality(pa, pc, pd);
  if (std::min(kept, swapped) > kSimilarShape * std::max(kept, swapped)) {
    const double kept_m2 = site(t).sum2_m2 + site(u).sum2_m2;
    if (kept_m2 == 0) return false;
    const ScanResult abc = scan(a, b, c);
    if (abc.sum2_m2 >= kept_m2) return false;
    const ScanResult acd = scan(a, c, d);
    if (abc.sum2_m2 + acd.sum2_m2 >= kept_m2) return false;
    mesh_.flip(e);
    store(t, abc);
    store(u, acd);
    return true;
  }
  if (swapped <= kept) return false;
  const std::size_t before = mesh_.touched().size();
  mesh_.flip(e);
  mark_stale(before);
  return true;
}

Refinement::Outcome Refinement::run(double bound_m, std::size_t max_triangles, std::size_t max_insertions) {
  bound_m_ = bound_m;
  sites_.assign(mesh_.triangle_count(), {});
  heap_.clear();
  heap_at_.assign(mesh_.triangle_count(), -1);
  mesh_.clear_touched();
  for (std::int32_t t = 0; t < static_cast<std::int32_t>(mesh_.triangle_count()); ++t) {
    site(t);
    heap_update(t);
  }
  Outcome outcome;
  const auto top_error = [&] { return heap_.empty() ? 0.0 : heap_[0].error_m; };
  outcome.error_m = outcome.best_error_m = top_error();
  while (!heap_.empty() && mesh_.triangle_count() + 2 <= max_triangles &&
         outcome.insertions < max_insertions) {
    const Entry worst = heap_[0];
    insert(worst.triangle, {worst.post % cols_, worst.post / cols_});
    for (const std::int32_t u : mesh_.touched()) {
      site(u);
      heap_update(u);
    }
    mesh_.clear_touched();
    ++outcome.insertions;
    outcome.error_m = top_error();
    if (outcome.error_m < outcome.best_error_m) {
      outcome.best_error_m = outcome.error_m;
      outcome.best_insertions = outcome.insertions;
    }
  }
  return outcome;
}

void Refinement::place(std::size_t at, const Entry& entry) {
  heap_[at] = entry;
  heap_at_[static_cast<std::size_t>(entry.triangle)] = static_cast<std::int32_t>(at);
}

void Refinement::heap_update(std::int32_t t) {
  const Site& now = sites_[static_cast<std::size_t>(t)];
  const std::int32_t at = heap_at_[static_cast<std::size_t>(t)];
  if (!(now.error_m > bound_m_)) {
    if (at >= 0) heap_remove(t);
    return;
  }
  const Entry entry{now.error_m, now.post, t};
  if (at < 0) {
    heap_.push_back(entry);
    sift_up(heap_.size() - 1);
  } else {
    heap_[static_cast<std::size_t>(at)] = entry;
    sift_up(static_cast<std::size_t>(at));
    sift_down(static_cast<std::size_t>(heap_at_[static_cast<std::size_t>(t)]));
  }
}

void Refinement::heap_remove(std::int32_t t) {
  const auto at = static_cast<std::size_t>(heap_at_[static_cast<std::size_t>(t)]);
  const Entry moved = heap_.back();
  heap_.pop_back();
  heap_at_[static_cast<std::size_t>(t)] = -1;
  if (moved.triangle == t) return;
  place(at, moved);
  sift_up(at);
  sift_down(static_cast<std::size_t>(heap_at_[static_cast<std::size_t>(moved.triangle)]));
}

void Refinement::sift_up(std::size_t at) {
  const Entry entry = heap_[at];
  for (; at > 0 && entry.is_before(heap_[(at - 1) / 2]); at = (at - 1) / 2) place(at, heap_[(at - 1) / 2]);
  place(at, entry);
}

void Refinement::sift_down(std::size_t at) {
  const Entry entry = heap_[at];
  for (std::size_t child = 2 * at + 1; child < heap_.size(); child = 2 * at + 1) {
    if (child + 1 < heap_.size() && heap_[child + 1].is_before(heap_[child])) ++child;
    if (!heap_[child].is_before(entry)) break;
    place(at, heap_[child]);
    at = child;
  }
  place(at, entry);
}

}  // namespace lodestone
