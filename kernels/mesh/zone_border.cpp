#include "kernels/mesh/zone_border.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <numeric>

namespace lodestone {
namespace {

// Directions E, S, W, N as (dcol, drow).
constexpr std::array<LatticePoint, 4> kStep{{{1, 0}, {0, 1}, {-1, 0}, {0, -1}}};

bool precedes(const LatticePoint& a, const LatticePoint& b) {
  return a.row < b.row || (a.row == b.row && a.col < b.col);
}

double squared_distance_to_segment(const LatticePoint& p, const LatticePoint& a, const LatticePoint& b) {
  const std::int64_t dx = b.col - a.col, dy = b.row - a.row;
  const std::int64_t px = p.col - a.col, py = p.row - a.row;
  const std::int64_t length2 = dx * dx + dy * dy;
  const std::int64_t along = px * dx + py * dy;
  if (along <= 0 || length2 == 0) return static_cast<double>(px * px + py * py);
  if (along >= length2) {
    const std::int64_t qx = p.col - b.col, qy = p.row - b.row;
    return static_cast<double>(qx * qx + qy * qy);
  }
  const double cross = static_cast<double>(px * dy - py * dx);
  return cross * cross / static_cast<double>(length2);
}

// Keeps the ends of [first, last] and what epsilon demands between them.
void split_chain(const std::vector<LatticePoint>& points, std::size_t first, std::size_t last, double epsilon,
                 std::vector<std::uint8_t>& keep) {
  std::vector<std::pair<std::size_t, std::size_t>> stack{{first, last}};
  while (!stack.empty()) {
    const auto [i, j] = stack.back();
    stack.pop_back();
    keep[i] = keep[j] = 1;
    double worst = -1;
    std::size_t at = i;
    for (std::size_t k = i + 1; k < j; ++k) {
      const double d2 = squared_distance_to_segment(points[k], points[i], points[j]);
      if (d2 > worst) {
        worst = d2;
        at = k;
      }
    }
    if (at == i || worst < epsilon * epsilon) continue;
    stack.emplace_back(i, at);
    stack.emplace_back(at, j);
  }
}

std::vector<LatticePoint> without_collinear(const std::vector<LatticePoint>& points) {
  std::vector<LatticePoint> kept{points.front()};
  for (std::size_t i = 1; i + 1 < points.size(); ++i) {
    if (orient(points[i - 1], points[i], points[i + 1]) != 0) kept.push_back(points[i]);
  }
  kept.push_back(points.back());
  return kept;
}

std::vector<LatticePoint> simplified(const std::vector<LatticePoint>& unit, double epsilon) {
  const std::vector<LatticePoint> points = without_collinear(unit);
  if (epsilon <= 0 || points.size() < 3) return points;
  std::vector<std::uint8_t> keep(points.size(), 0);
  const std::size_t last = points.size() - 1;
  if (points.front() == points.back()) {
    std::size_t far = 0;
    std::int64_t far_d2 = -1;
    for (std::size_t i = 1; i < last; ++i) {
      const std::int64_t dx = points[i].col - points[0].col, dy = points[i].row - points[0].row;
      if (dx * dx + dy * dy > far_d2) {
        far_d2 = dx * dx + dy * dy;
        far = i;
      }
    }
    split_chain(points, 0, far, epsilon, keep);
    split_chain(points, far, last, epsilon, keep);
  } else {
    split_chain(points, 0, last, epsilon, keep);
  }
  std::vector<LatticePoint> result;
  for (std::size_t i = 0; i < points.size(); ++i) {
    if (keep[i]) result.push_back(points[i]);
  }
  return result;
}

struct Segment {
  LatticePoint a, b;
  std::size_t chain;
};

bool is_between(const LatticePoint& p, const LatticePoint& a, const LatticePoint& b) {
  return p.col >= std::min(a.col, b.col) && p.col <= std::max(a.col, b.col) &&
         p.row >= std::min(a.row, b.row) && p.row <= std::max(a.row, b.row);
}
bool is_inside(const LatticePoint& p, const LatticePoint& a, const LatticePoint& b) {
  return p != a && p != b && is_between(p, a, b) && orient(a, b, p) == 0;
}

// May s and t both be edges of one triangulation?
bool is_compatible(const Segment& s, const Segment& t) {
  if ((s.a == t.a && s.b == t.b) || (s.a == t.b && s.b == t.a)) return false;
  if (is_inside(s.a, t.a, t.b) || is_inside(s.b, t.a, t.b) || is_inside(t.a, s.a, s.b) ||
      is_inside(t.b, s.a, s.b)) {
    return false;
  }
  const std::int64_t o1 = orient(s.a, s.b, t.a), o2 = orient(s.a, s.b, t.b);
  const std::int64_t o3 = orient(t.a, t.b, s.a), o4 = orient(t.a, t.b, s.b);
  return !(((o1 > 0 && o2 < 0) || (o1 < 0 && o2 > 0)) && ((o3 > 0 && o4 < 0) || (o3 < 0 && o4 > 0)));
}

bool lies_on_edge(const Segment& s, std::int32_t cols, std::int32_t rows) {
  return (s.a.col == s.b.col && (s.a.col == 0 || s.a.col == cols)) ||
         (s.a.row == s.b.row && (s.a.row == 0 || s.a.row == rows));
}

// Chains of which some segment breaks a rule. cols, rows: cells.
std::vector<std::uint8_t> illegal_chains(const std::vector<ZoneChain>& chains, std::int32_t cols,
                                         std::int32_t rows) {
  constexpr int kBucketShift = 4;
  std::vector<std::uint8_t> is_illegal(chains.size(), 0);
  std::vector<Segment> segments;
  for (std::size_t c = 0; c < chains.size(); ++c) {
    for (std::size_t i = 0; i + 1 < chains[c].points.size(); ++i) {
      segments.push_back({chains[c].points[i], chains[c].points[i + 1], c});
      if (lies_on_edge(segments.back(), cols, rows)) is_illegal[c] = 1;
    }
    if (chains[c].points.front() == chains[c].points.back() && chains[c].points.size() < 4) is_illegal[c] = 1;
  }
  const std::int32_t width = (cols >> kBucketShift) + 1;
  std::vector<std::vector<std::uint32_t>> buckets(static_cast<std::size_t>(width) *
                                                  static_cast<std::size_t>((rows >> kBucketShift) + 1));
  for (std::uint32_t s = 0; s < segments.size(); ++s) {
    const auto [c0, c1] = std::minmax(segments[s].a.col, segments[s].b.col);
    const auto [r0, r1] = std::minmax(segments[s].a.row, segments[s].b.row);
    for (std::int32_t r = r0 >> kBucketShift; r <= r1 >> kBucketShift; ++r) {
      for (std::int32_t c = c0 >> kBucketShift; c <= c1 >> kBucketShift; ++c) {
        auto& bucket = buckets[static_cast<std::size_t>(r) * static_cast<std::size_t>(width) +
                               static_cast<std::size_t>(c)];
        for (const std::uint32_t t : bucket) {
          if (is_illegal[segments[s].chain] && is_illegal[segments[t].chain]) continue;
          if (!is_compatible(segments[s], segments[t]))
            is_illegal[segments[s].chain] = is_illegal[segments[t].chain] = 1;
        }
        bucket.push_back(s);
      }
    }
  }
  return is_illegal;
}

}  // namespace

std::uint16_t CellLabels::at(std::int32_t col, std::int32_t row) const {
  const std::int32_t c = std::clamp(col, -halo, cols + halo - 1) + halo;
  const std::int32_t r = std::clamp(row, -halo, rows + halo - 1) + halo;
  return labels[static_cast<std::size_t>(r) * static_cast<std::size_t>(cols + 2 * halo) +
                static_cast<std::size_t>(c)];
}

void sieve_zones(CellLabels& map, std::int32_t min_cells) {
  const std::int32_t width = map.cols + 2 * map.halo, height = map.rows + 2 * map.halo;
  const auto count = static_cast<std::size_t>(width) * static_cast<std::size_t>(height);
  std::vector<std::int32_t> region(count);
  while (true) {
    // Regions by flood fill, numbered in row-major order of their first cells.
    std::fill(region.begin(), region.end(), -1);
    std::vector<std::vector<std::int32_t>> cells;
    for (std::size_t i = 0; i < count; ++i) {
      if (region[i] >= 0) continue;
      const auto id = static_cast<std::int32_t>(cells.size());
      cells.emplace_back(1, static_cast<std::int32_t>(i));
      region[i] = id;
      for (std::size_t k = 0; k < cells.back().size(); ++k) {
        const std::int32_t c = cells.back()[k] % width, r = cells.back()[k] / width;
        for (const LatticePoint& d : kStep) {
          if (c + d.col < 0 || c + d.col >= width || r + d.row < 0 || r + d.row >= height) continue;
          const std::int32_t n = (r + d.row) * width + c + d.col;
          if (region[static_cast<std::size_t>(n)] >= 0 ||
              map.labels[static_cast<std::size_t>(n)] != map.labels[i])
            continue;
          region[static_cast<std::size_t>(n)] = id;
          cells.back().push_back(n);
        }
      }
    }
    const auto smallest = std::min_element(cells.begin(), cells.end(),
                                           [](const auto& a, const auto& b) { return a.size() < b.size(); });
    if (cells.size() < 2 || static_cast<std::int64_t>(smallest->size()) >= min_cells) return;
    // Every region of the smallest size joins its neighbour; those that touch one another wait for the next
    // round.
    const std::size_t size = smallest->size();
    std::vector<std::uint8_t> is_changed(cells.size(), 0);
    for (std::size_t id = 0; id < cells.size(); ++id) {
      if (cells[id].size() != size) continue;
      std::map<std::uint16_t, std::int32_t> contact;
      bool is_free = true;
      for (const std::int32_t cell : cells[id]) {
        const std::int32_t c = cell % width, r = cell / width;
        for (const LatticePoint& d : kStep) {
          if (c + d.col < 0 || c + d.col >= width || r + d.row < 0 || r + d.row >= height) continue;
          const auto n = static_cast<std::size_t>((r + d.row) * width + c + d.col);
          if (region[n] == static_cast<std::int32_t>(id)) continue;
          is_free = is_free && !is_changed[static_cast<std::size_t>(region[n])];
          ++contact[map.labels[n]];
        }
      }
      if (!is_free) continue;
      const auto best = std::max_element(contact.begin(), contact.end(),
                                         [](const auto& a, const auto& b) { return a.second < b.second; });
      for (const std::int32_t cell : cells[id]) map.labels[static_cast<std::size_t>(cell)] = best->first;
      is_changed[id] = 1;
    }
  }
}

CellLabels with_transitions(const CellLabels& map, std::int32_t width) {
  CellLabels marked = map;
  const std::int32_t limit = width * width + width;  // integer d2 < (width + 0.5)^2
  std::size_t at = 0;
  for (std::int32_t row = -map.halo; row < map.rows + map.halo; ++row) {
    for (std::int32_t col = -map.halo; col < map.cols + map.halo; ++col, ++at) {
      const std::uint16_t own = map.labels[at];
      std::int32_t nearest = limit + 1;
      int other = -1;
      for (std::int32_t dr = -width; dr <= width; ++dr) {
        for (std::int32_t dc = -width; dc <= width; ++dc) {
          const std::int32_t d2 = dr * dr + dc * dc;
          if (d2 > limit || d2 > nearest) continue;
          const std::uint16_t label = map.at(col + dc, row + dr);
          if (label == own || (d2 == nearest && label >= other)) continue;
          nearest = d2;
          other = label;
        }
      }
      if (other >= 0 && own <= kMaxZone && other <= kMaxZone) marked.labels[at] = transition_zone(own, other);
    }
  }
  return marked;
}

float transition_blend(const CellLabels& marked, std::int32_t col, std::int32_t row, int a, int b,
                       std::int32_t reach) {
  double near_a = reach + 1, near_b = reach + 1;
  near_a *= near_a;
  near_b *= near_b;
  for (std::int32_t r = row - reach - 1; r <= row + reach; ++r) {
    for (std::int32_t c = col - reach - 1; c <= col + reach; ++c) {
      const std::uint16_t label = marked.at(c, r);
      if (label != a && label != b) continue;
      const std::int32_t dc = std::max({c - col, col - c - 1, 0}), dr = std::max({r - row, row - r - 1, 0});
      double& near = label == a ? near_a : near_b;
      near = std::min(near, static_cast<double>(dc * dc + dr * dr));
    }
  }
  const double da = std::sqrt(near_a), db = std::sqrt(near_b);
  return da + db > 0 ? static_cast<float>(da / (da + db)) : 0.5F;
}

std::vector<ZoneChain> trace_zone_borders(const CellLabels& map) {
  const std::int32_t cols = map.cols + 1, rows = map.rows + 1;
  const auto index = [cols](const LatticePoint& p) {
    return static_cast<std::size_t>(p.row) * static_cast<std::size_t>(cols) + static_cast<std::size_t>(p.col);
  };
  // Bit d of a post: a border runs from it in direction d.
  std::vector<std::uint8_t> ways(static_cast<std::size_t>(cols) * static_cast<std::size_t>(rows), 0);
  for (std::int32_t r = 0; r < rows; ++r) {
    for (std::int32_t c = 0; c < cols; ++c) {
      if (c + 1 < cols && r > 0 && r + 1 < rows && map.at(c, r - 1) != map.at(c, r)) {
        ways[index({c, r})] |= 1;
        ways[index({c + 1, r})] |= 4;
      }
      if (r + 1 < rows && c > 0 && c + 1 < cols && map.at(c - 1, r) != map.at(c, r)) {
        ways[index({c, r})] |= 2;
        ways[index({c, r + 1})] |= 8;
      }
    }
  }
  const auto is_node = [&](const LatticePoint& p) {
    const int degree = __builtin_popcount(ways[index(p)]);
    return degree != 2 || p.col == 0 || p.row == 0 || p.col == cols - 1 || p.row == rows - 1;
  };
  std::vector<std::uint8_t> used(ways.size(), 0);
  const auto walk = [&](LatticePoint p, int direction) {
    ZoneChain chain;
    const LatticePoint start = p;
    const LatticePoint d0 = kStep[static_cast<std::size_t>(direction)];
    // Cells beside the first step, north up: left of east is north.
    const std::int32_t c = std::min(p.col, p.col + d0.col), r = std::min(p.row, p.row + d0.row);
    switch (direction) {
      case 0:
        chain.left = map.at(c, r - 1);
        chain.right = map.at(c, r);
        break;
      case 1:
        chain.left = map.at(c, r);
        chain.right = map.at(c - 1, r);
        break;
      case 2:
        chain.left = map.at(c, r);
        chain.right = map.at(c, r - 1);
        break;
      default:
        chain.left = map.at(c - 1, r);
        chain.right = map.at(c, r);
        break;
    }
    chain.points.push_back(p);
    while (true) {
      used[index(p)] = static_cast<std::uint8_t>(used[index(p)] | 1 << direction);
      p = {p.col + kStep[static_cast<std::size_t>(direction)].col,
           p.row + kStep[static_cast<std::size_t>(direction)].row};
      const int back = (direction + 2) % 4;
      used[index(p)] = static_cast<std::uint8_t>(used[index(p)] | 1 << back);
      chain.points.push_back(p);
      if (is_node(p) || p == start) break;
      const int onward = ways[index(p)] & ~(1 << back);
      direction = __builtin_ctz(static_cast<unsigned>(onward));
    }
    return chain;
  };
  std::vector<ZoneChain> chains;
  for (const bool is_loop_pass : {false, true}) {
    for (std::int32_t r = 0; r < rows; ++r) {
      for (std::int32_t c = 0; c < cols; ++c) {
        const LatticePoint p{c, r};
        if (ways[index(p)] == 0 || (!is_loop_pass && !is_node(p))) continue;
        for (int d = 0; d < 4; ++d) {
          if (ways[index(p)] >> d & 1 && !(used[index(p)] >> d & 1)) chains.push_back(walk(p, d));
        }
      }
    }
  }
  std::stable_sort(chains.begin(), chains.end(),
                   [](const ZoneChain& a, const ZoneChain& b) { return precedes(a.points[0], b.points[0]); });
  return chains;
}

std::vector<ZoneChain> simplify_zone_borders(const std::vector<ZoneChain>& unit_chains, std::int32_t cols,
                                             std::int32_t rows, double epsilon, std::uint16_t exact_label) {
  std::vector<double> epsilons(unit_chains.size(), epsilon);
  std::vector<ZoneChain> result = unit_chains;
  for (std::size_t c = 0; c < result.size(); ++c) {
    if (result[c].left == exact_label || result[c].right == exact_label) epsilons[c] = 0;
    result[c].points = simplified(unit_chains[c].points, epsilons[c]);
  }
  while (true) {
    const std::vector<std::uint8_t> is_illegal = illegal_chains(result, cols, rows);
    bool has_changed = false;
    for (std::size_t c = 0; c < result.size(); ++c) {
      if (!is_illegal[c] || epsilons[c] <= 0) continue;
      epsilons[c] = epsilons[c] / 2 < 0.1 ? 0 : epsilons[c] / 2;
      result[c].points = simplified(unit_chains[c].points, epsilons[c]);
      has_changed = true;
    }
    if (!has_changed) return result;
  }
}

std::vector<std::uint8_t> required_edge_posts(const CellLabels& map, bool along_rows, std::int32_t at) {
  const std::int32_t length = along_rows ? map.rows : map.cols;
  std::vector<std::uint8_t> is_required(static_cast<std::size_t>(length) + 1, 0);
  is_required.front() = is_required.back() = 1;
  for (std::int32_t k = 1; k < length; ++k) {
    const auto cell = [&](std::int32_t across, std::int32_t along) {
      return along_rows ? map.at(at + across, k + along) : map.at(k + along, at + across);
    };
    is_required[static_cast<std::size_t>(k)] = cell(-1, -1) != cell(-1, 0) || cell(0, -1) != cell(0, 0);
  }
  return is_required;
}

}  // namespace lodestone
