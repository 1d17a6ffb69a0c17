#pragma once
// Refinement: greedy insertion into a constrained triangulation, the loop of the TIN.

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "kernels/mesh/tin.h"
#include "kernels/mesh/triangle_scan.h"
#include "kernels/mesh/triangulation.h"

namespace lodestone {

// One segment of a simplified zone border; left and right as seen from a to b, north up.
struct BorderSegment {
  LatticePoint a, b;
  std::uint16_t left = 0, right = 0;
  bool is_tied = true;  // may be moved to posts beside it
};

class Refinement {
 public:
  // heights_m: cols * rows. work_m: the same with NaN where no vertex may go (tile edges, vertices, voids),
  // followed by kScanPadding floats. segments: by constraint number. zone: one per triangle, or empty. All
  // spans outlive the object.
  Refinement(Triangulation& mesh, std::span<const float> heights_m, std::span<float> work_m,
             std::int32_t cols, std::span<const BorderSegment> segments, std::vector<std::uint16_t>& zone,
             TinCriterion criterion, double tie_cells);

  struct Outcome {
    std::size_t insertions = 0;
    double error_m = 0;               // largest error left among the free posts
    std::size_t best_insertions = 0;  // prefix with the smallest such error
    double best_error_m = 0;
  };
  // Inserts while some error exceeds bound_m, the mesh stays within max_triangles, and fewer than
  // max_insertions were made.
  Outcome run(double bound_m, std::size_t max_triangles, std::size_t max_insertions);

 private:
  struct Site {
    double error_m = 0, sum2_m2 = 0;
    std::int32_t post = -1;
    bool is_fresh = false;
  };
  ScanPoint scan_point(std::int32_t v) const;
  ScanResult scan(std::int32_t a, std::int32_t b, std::int32_t c) const;
  void store(std::int32_t t, const ScanResult& result);
  const Site& site(std::int32_t t);
  void mark_stale(std::size_t first_touched);
  void insert(std::int32_t t, const LatticePoint& p);
  std::int32_t tied_edge(std::int32_t t, const LatticePoint& p) const;
  void legalize(std::int32_t vertex);
  bool try_swap(std::int32_t e);

  // Keys are copied into the heap: sites change several at a time, the heap one by one.
  struct Entry {
    double error_m;
    std::int32_t post, triangle;
    bool is_before(const Entry& other) const {
      if (error_m != other.error_m) return error_m > other.error_m;
      return post != other.post ? post < other.post : triangle < other.triangle;
    }
  };
  void place(std::size_t at, const Entry& entry);
  void heap_update(std::int32_t t);
  void heap_remove(std::int32_t t);
  void sift_up(std::size_t at);
  void sift_down(std::size_t at);

  Triangulation& mesh_;
  std::span<const float> heights_m_;
  std::span<float> work_m_;
  std::int32_t cols_;
  std::span<const BorderSegment> segments_;
  std::vector<std::uint16_t>& zone_;
  TinCriterion criterion_;
  double tie_cells_;
  ScanField field_;
  double bound_m_ = 0;
  std::vector<Site> sites_;
  std::vector<Entry> heap_;            // worst first
  std::vector<std::int32_t> heap_at_;  // place of each triangle or -1
  std::vector<std::int32_t> stack_;
};

}  // namespace lodestone
