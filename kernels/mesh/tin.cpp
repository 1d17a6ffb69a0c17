// Order of work: labels -> edges -> zone chains -> constrained Delaunay start -> greedy refinement -> mesh.

#include "kernels/mesh/tin.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <string>

#include "kernels/mesh/refinement.h"
#include "kernels/mesh/tile_border.h"
#include "kernels/mesh/zone_border.h"

namespace lodestone {
namespace {

constexpr std::uint16_t kHoleLabel = 0x7fff;  // no zone id and no transition
constexpr std::int32_t kMaxCells = 8192;      // in_circle stays exact
constexpr double kSmallestEpsilon = 0.1;

Error invalid(const std::string& what) { return {ErrorCode::kInvalidArgument, "TIN request: " + what}; }

Result<void> check_field(const PostField& field) {
  if (field.cols < 2 || field.rows < 2 || field.halo < 0) {
    return invalid("at least 2 x 2 posts and halo >= 0 are needed, found " + std::to_string(field.cols) +
                   " x " + std::to_string(field.rows) + ", halo " + std::to_string(field.halo));
  }
  if (field.cols > kMaxCells + 1 || field.rows > kMaxCells + 1) {
    return Error{ErrorCode::kTooLarge, "TIN request: at most " + std::to_string(kMaxCells + 1) +
                                           " posts a side, found " + std::to_string(field.cols) + " x " +
                                           std::to_string(field.rows) + "; mesh it in tiles"};
  }
  const std::size_t expected =
      static_cast<std::size_t>(field.cols + 2 * static_cast<std::int64_t>(field.halo)) *
      static_cast<std::size_t>(field.rows + 2 * static_cast<std::int64_t>(field.halo));
  if (field.heights_m.size() != expected || (!field.is_void.empty() && field.is_void.size() != expected)) {
    return invalid(std::to_string(expected) + " heights expected, found " +
                   std::to_string(field.heights_m.size()) + " and " + std::to_string(field.is_void.size()) +
                   " void flags");
  }
  for (const float h : field.heights_m) {
    if (!std::isfinite(h)) return invalid("every height must be finite; fill voids first");
  }
  return {};
}

Result<void> check(const TinRequest& request) {
  if (Result<void> field = check_field(request.field); !field) return field;
  if (!request.max_error_m && !request.max_triangles)
    return invalid("max_error_m or max_triangles must be set");
  if (!request.max_error_m && !request.edge_error_m)
    return invalid("a triangle budget needs edge_error_m, the same for all tiles of a level");
  for (const std::optional<double>& bound : {request.max_error_m, request.edge_error_m}) {
    if (bound && !(*bound >= 0 && std::isfinite(*bound)))
      return invalid("error bounds must be finite and >= 0, found " + std::to_string(*bound));
  }
  if (!request.zones) return {};
  const ZoneField& zones = *request.zones;
  const std::int64_t w = request.field.cols - 1 + 2 * static_cast<std::int64_t>(zones.halo);
  const std::int64_t h = request.field.rows - 1 + 2 * static_cast<std::int64_t>(zones.halo);
  if (zones.halo < 0 || static_cast<std::int64_t>(zones.labels.size()) != w * h) {
    return invalid("zone labels: one per cell and halo cell expected, " + std::to_string(w * h) + ", found " +
                   std::to_string(zones.labels.size()));
  }
  for (const std::uint16_t label : zones.labels) {
    if (label > kMaxZone) return invalid("zone ids are 0..127, found " + std::to_string(label));
  }
  if (!(zones.epsilon_cells >= 0 && zones.tie_cells >= 0 && std::isfinite(zones.epsilon_cells) &&
        std::isfinite(zones.tie_cells))) {
    return invalid("zone epsilon and tie must be finite and >= 0");
  }
  if (zones.transition_cells < 0 || zones.transition_cells > 64)
    return invalid("transition_cells must be 0..64");
  return {};
}

// Zone labels with holes marked; empty labels when there is nothing to separate.
CellLabels cell_labels(const TinRequest& request) {
  const PostField& field = request.field;
  CellLabels map;
  map.cols = field.cols - 1;
  map.rows = field.rows - 1;
  const bool has_holes =
      request.voids == TinVoids::kHole &&
      std::any_of(field.is_void.begin(), field.is_void.end(), [](auto v) { return v != 0; });
  if (request.zones) {
    map.halo = request.zones->halo;
    map.labels.assign(request.zones->labels.begin(), request.zones->labels.end());
    if (request.zones->transition_cells > 0) map = with_transitions(map, request.zones->transition_cells);
  } else if (has_holes) {
    map.halo = std::min(field.halo, 1);
    map.labels.assign(
        static_cast<std::size_t>(map.cols + 2 * map.halo) * static_cast<std::size_t>(map.rows + 2 * map.halo),
        0);
  }
  if (!has_holes) return map;
  std::size_t at = 0;
  for (std::int32_t row = -map.halo; row < map.rows + map.halo; ++row) {
    for (std::int32_t col = -map.halo; col < map.cols + map.halo; ++col, ++at) {
      const auto is_void = [&](std::int32_t c, std::int32_t r) {
        return field.void_at(std::clamp(c, -field.halo, field.cols - 1 + field.halo),
                             std::clamp(r, -field.halo, field.rows - 1 + field.halo));
      };
      if (is_void(col, row) || is_void(col + 1, row) || is_void(col, row + 1) || is_void(col + 1, row + 1))
        map.labels[at] = kHoleLabel;
    }
  }
  return map;
}

struct Start {
  Triangulation mesh;
  std::vector<BorderSegment> segments;
  std::vector<std::uint16_t> zone;  // per triangle; empty without labels
};

class TinBuilder {
 public:
  explicit TinBuilder(const TinRequest& request)
      : request_(request),
        field_(request.field),
        cols_(field_.cols),
        rows_(field_.rows),
        labels_(cell_labels(request)) {
    heights_.reserve(static_cast<std::size_t>(cols_) * static_cast<std::size_t>(rows_));
    for (std::int32_t row = 0; row < rows_; ++row) {
      const auto first = field_.heights_m.begin() + static_cast<std::ptrdiff_t>(field_.index(0, row));
      heights_.insert(heights_.end(), first, first + cols_);
    }
  }

  TinMesh build() {
    choose_edge_posts();
    if (!labels_.labels.empty()) unit_chains_ = trace_zone_borders(labels_);
    const double bound = request_.max_error_m.value_or(0);
    const std::size_t budget = request_.max_triangles.value_or(std::numeric_limits<std::size_t>::max());
    Start start = make_start();
    const Refinement::Outcome outcome = refine(start, bound, budget, std::numeric_limits<std::size_t>::max());
    // Greedy insertion may end on a worse surface than it had before: a budget that ran out goes back to its
    // best.
    if (outcome.error_m > bound && outcome.best_insertions < outcome.insertions) {
      start = make_start();
      refine(start, bound, budget, outcome.best_insertions);
    }
    return finish(start);
  }

 private:
  std::size_t index(std::int32_t col, std::int32_t row) const {
    return static_cast<std::size_t>(row) * static_cast<std::size_t>(cols_) + static_cast<std::size_t>(col);
  }

  void choose_edge_posts() {
    const double tolerance = request_.edge_error_m.value_or(request_.max_error_m.value_or(0));
    const bool has_holes = request_.voids == TinVoids::kHole;
    for (const bool along_rows : {true, false}) {
      for (const std::int32_t at : {0, along_rows ? cols_ - 1 : rows_ - 1}) {
        const std::int32_t length = along_rows ? rows_ : cols_;
        std::vector<float> heights;
        std::vector<std::uint8_t> is_void, is_required;
        for (std::int32_t k = 0; k < length; ++k) {
          const LatticePoint p = along_rows ? LatticePoint{at, k} : LatticePoint{k, at};
          heights.push_back(heights_[index(p.col, p.row)]);
          is_void.push_back(has_holes && field_.void_at(p.col, p.row));
        }
        if (!labels_.labels.empty()) is_required = required_edge_posts(labels_, along_rows, at);
        for (const std::int32_t k : simplify_edge(heights, is_required, is_void, tolerance)) {
          edge_posts_.push_back(along_rows ? LatticePoint{at, k} : LatticePoint{k, at});
        }
      }
    }
  }

  // Constrained Delaunay triangulation of edges and zone borders. An island may end up on the wrong side of a
  // moved border; then the whole tile is tried with a smaller epsilon, at last with the exact borders, which
  // cannot contradict.
  Start make_start() const {
    double epsilon = request_.zones ? request_.zones->epsilon_cells : 0;
    while (true) {
      Start start{Triangulation(cols_, rows_), {}, {}};
      if (place_borders(start, epsilon) && fill_zones(start)) return start;
      epsilon = epsilon / 2 < kSmallestEpsilon ? 0 : epsilon / 2;
    }
  }

  bool place_borders(Start& start, double epsilon) const {
    std::int32_t hint = 0;
    for (const LatticePoint& p : edge_posts_) start.mesh.add_delaunay(p, hint);
    const std::vector<ZoneChain> chains =
        simplify_zone_borders(unit_chains_, cols_ - 1, rows_ - 1, epsilon, kHoleLabel);
    std::vector<std::pair<std::int32_t, std::int32_t>> ends;
    for (const ZoneChain& chain : chains) {
      std::int32_t from = start.mesh.add_delaunay(chain.points[0], hint);
      for (std::size_t i = 1; i < chain.points.size(); ++i) {
        const std::int32_t to = start.mesh.add_delaunay(chain.points[i], hint);
        ends.emplace_back(from, to);
        const bool is_exact = chain.left == kHoleLabel || chain.right == kHoleLabel;
        start.segments.push_back({chain.points[i - 1], chain.points[i], chain.left, chain.right, !is_exact});
        from = to;
      }
    }
    for (std::size_t s = 0; s < ends.size(); ++s) {
      if (!start.mesh.add_constraint(ends[s].first, ends[s].second, static_cast<std::int32_t>(s)))
        return false;
    }
    start.mesh.relax();
    return true;
  }

  // Floods the zone of each border side through free edges. False when two sides of one region disagree.
  bool fill_zones(Start& start) const {
    if (labels_.labels.empty()) return true;
    const Triangulation& mesh = start.mesh;
    if (start.segments.empty()) {
      start.zone.assign(mesh.triangle_count(), labels_.at(0, 0));
      return true;
    }
    constexpr std::int32_t kUnset = -1;
    std::vector<std::int32_t> zone(mesh.triangle_count(), kUnset);
    std::vector<std::int32_t> stack;
    for (std::int32_t e = 0; e < static_cast<std::int32_t>(3 * mesh.triangle_count()); ++e) {
      if (mesh.constraint(e) == Triangulation::kNone) continue;
      const BorderSegment& s = start.segments[static_cast<std::size_t>(mesh.constraint(e))];
      const std::int32_t seed = mesh.point(mesh.origin(e)) == s.a ? s.left : s.right;
      stack.push_back(e / 3);
      while (!stack.empty()) {
        const std::int32_t t = stack.back();
        stack.pop_back();
        std::int32_t& own = zone[static_cast<std::size_t>(t)];
        if (own == seed) continue;
        if (own != kUnset) return false;
        own = seed;
        for (std::int32_t x = 3 * t; x < 3 * t + 3; ++x) {
          if (!mesh.is_fixed(x)) stack.push_back(mesh.twin(x) / 3);
        }
      }
    }
    start.zone.assign(zone.begin(), zone.end());
    return true;
  }

  Refinement::Outcome refine(Start& start, double bound, std::size_t budget, std::size_t max_insertions) {
    constexpr float kNoVertex = std::numeric_limits<float>::quiet_NaN();
    work_ = heights_;
    for (std::int32_t row = 0; row < rows_; ++row) {
      work_[index(0, row)] = work_[index(cols_ - 1, row)] = kNoVertex;
    }
    for (std::int32_t col = 0; col < cols_; ++col)
      work_[index(col, 0)] = work_[index(col, rows_ - 1)] = kNoVertex;
    if (request_.voids == TinVoids::kHole && !field_.is_void.empty()) {
      for (std::int32_t row = 0; row < rows_; ++row) {
        for (std::int32_t col = 0; col < cols_; ++col) {
          if (field_.void_at(col, row)) work_[index(col, row)] = kNoVertex;
        }
      }
    }
    blank_hole_posts();
    for (std::int32_t v = 0; v < static_cast<std::int32_t>(start.mesh.vertex_count()); ++v) {
      const LatticePoint& p = start.mesh.point(v);
      work_[index(p.col, p.row)] = kNoVertex;
    }
    work_.resize(work_.size() + kScanPadding, kNoVertex);
    const double tie = request_.zones ? request_.zones->tie_cells : 0;
    Refinement refinement(start.mesh, heights_, work_, cols_, start.segments, start.zone, request_.criterion,
                          tie);
    return refinement.run(bound, budget, max_insertions);
  }

  // Posts with holes all around are not part of the surface.
  void blank_hole_posts() {
    if (request_.voids != TinVoids::kHole || labels_.labels.empty()) return;
    for (std::int32_t row = 1; row + 1 < rows_; ++row) {
      for (std::int32_t col = 1; col + 1 < cols_; ++col) {
        if (labels_.at(col, row) == kHoleLabel && labels_.at(col - 1, row) == kHoleLabel &&
            labels_.at(col, row - 1) == kHoleLabel && labels_.at(col - 1, row - 1) == kHoleLabel) {
          work_[index(col, row)] = std::numeric_limits<float>::quiet_NaN();
        }
      }
    }
  }

  TinMesh finish(const Start& start) const {
    TinMesh mesh;
    mesh.cols = cols_;
    mesh.rows = rows_;
    mesh.i0 = request_.i0;
    mesh.j0 = request_.j0;
    const auto triangles = static_cast<std::int32_t>(start.mesh.triangle_count());
    mesh.triangles.reserve(3 * static_cast<std::size_t>(triangles));
    std::vector<std::uint32_t> number(start.mesh.vertex_count(), 0);
    std::vector<std::uint8_t> is_used(start.mesh.vertex_count(), 0);
    const auto is_hole = [&](std::int32_t t) {
      return !start.zone.empty() && start.zone[static_cast<std::size_t>(t)] == kHoleLabel;
    };
    for (std::int32_t e = 0; e < 3 * triangles; ++e) {
      if (!is_hole(e / 3)) is_used[static_cast<std::size_t>(start.mesh.origin(e))] = 1;
    }
    for (std::int32_t v = 0; v < static_cast<std::int32_t>(start.mesh.vertex_count()); ++v) {
      if (!is_used[static_cast<std::size_t>(v)]) continue;
      const LatticePoint& p = start.mesh.point(v);
      number[static_cast<std::size_t>(v)] = static_cast<std::uint32_t>(mesh.vertices.size());
      mesh.vertices.push_back({p.col, p.row, heights_[index(p.col, p.row)]});
    }
    const bool has_transitions = request_.zones && request_.zones->transition_cells > 0;
    for (std::int32_t t = 0; t < triangles; ++t) {
      if (is_hole(t)) continue;
      for (std::int32_t e = 3 * t; e < 3 * t + 3; ++e)
        mesh.triangles.push_back(number[static_cast<std::size_t>(start.mesh.origin(e))]);
      if (!request_.zones) continue;
      const std::uint16_t zone = start.zone[static_cast<std::size_t>(t)];
      mesh.zones.push_back(zone);
      if (!has_transitions) continue;
      for (std::int32_t e = 3 * t; e < 3 * t + 3; ++e) {
        const LatticePoint& p = start.mesh.point(start.mesh.origin(e));
        const std::int32_t reach = 2 * request_.zones->transition_cells + 2;
        mesh.blend.push_back(is_transition(zone) ? transition_blend(labels_, p.col, p.row, first_zone(zone),
                                                                    second_zone(zone), reach)
                                                 : 0.0F);
      }
    }
    mesh.top_vertices = mesh.vertices.size();
    mesh.top_triangles = mesh.triangle_count();
    PostField counted = field_;
    if (request_.voids == TinVoids::kFill) counted.is_void = {};  // fills are part of the surface
    const SurfaceError error = measure_error(mesh, counted);
    mesh.max_error_m = error.max_m;
    mesh.rms_error_m = error.rms_m;
    return mesh;
  }

  const TinRequest& request_;
  const PostField& field_;
  std::int32_t cols_, rows_;
  CellLabels labels_;
  std::vector<float> heights_, work_;
  std::vector<LatticePoint> edge_posts_;
  std::vector<ZoneChain> unit_chains_;
};

}  // namespace

Result<TinMesh> build_tin(const TinRequest& request) {
  if (Result<void> ok = check(request); !ok) return std::move(ok.error());
  return TinBuilder(request).build();
}

Result<TinMesh> build_grid_mesh(const PostField& field, std::int64_t i0, std::int64_t j0, std::int32_t step) {
  if (Result<void> ok = check_field(field); !ok) return std::move(ok.error());
  if (step < 1 || (field.cols - 1) % step != 0 || (field.rows - 1) % step != 0) {
    return invalid("the grid step must divide " + std::to_string(field.cols - 1) + " and " +
                   std::to_string(field.rows - 1) + ", found " + std::to_string(step));
  }
  TinMesh mesh;
  mesh.cols = field.cols;
  mesh.rows = field.rows;
  mesh.i0 = i0;
  mesh.j0 = j0;
  for (std::int32_t row = 0; row < field.rows; row += step) {
    for (std::int32_t col = 0; col < field.cols; col += step)
      mesh.vertices.push_back({col, row, field.at(col, row)});
  }
  const auto width = static_cast<std::uint32_t>((field.cols - 1) / step + 1),
             height = static_cast<std::uint32_t>((field.rows - 1) / step + 1);
  for (std::uint32_t r = 0; r + 1 < height; ++r) {
    for (std::uint32_t c = 0; c + 1 < width; ++c) {
      const std::uint32_t nw = r * width + c, sw = nw + width;
      mesh.triangles.insert(mesh.triangles.end(), {nw, sw, sw + 1, nw, sw + 1, nw + 1});
    }
  }
  mesh.top_vertices = mesh.vertices.size();
  mesh.top_triangles = mesh.triangle_count();
  const SurfaceError error = measure_error(mesh, field);
  mesh.max_error_m = error.max_m;
  mesh.rms_error_m = error.rms_m;
  return mesh;
}

}  // namespace lodestone
