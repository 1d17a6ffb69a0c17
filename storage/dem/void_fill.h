#pragma once
// Fills void posts with nearby surveyed heights, by a rule that depends on the post alone, so that tiles
// agree on shared posts. Source: SPEC-SYNTHESIS 3.6 (nearest valid height).
//   within kFillReach posts:  the nearest surveyed post, Euclidean in posts; ties to the lowest row, then the
//   lowest column farther away:             the mean of the nearest block (of 64 x 64 posts, or a power of
//   two more) that has surveyed posts

#include <cstdint>
#include <vector>

#include "kernels/types/height_grid.h"
#include "kernels/types/post_window.h"

namespace lodestone {

inline constexpr int kFillReach = 256;

// Sums per block of the world, gathered while reading; then the fill of every block. Not thread-safe while
// adding.
class FillBlocks {
 public:
  explicit FillBlocks(const PostWindow& world);
  // Partial sums of one read window, to be added on one thread. Whole 1/1024 m, so that the order of adding
  // cannot matter.
  struct Part {
    std::int64_t block = 0;
    std::int64_t sum_1024 = 0;
    std::int64_t count = 0;
  };
  // Sums of the posts of `owned` in `grid` (NaN heights are void).
  std::vector<Part> sums_of(const PostWindow& grid, const std::vector<float>& heights_m,
                            const PostWindow& owned) const;
  void add(const std::vector<Part>& parts);
  // Call once, after all parts: finds each block's nearest block with data.
  void finish();
  // After finish(): fill height for post (i, j); 0 if the world has no surveyed post at all.
  float at(std::int64_t i, std::int64_t j) const { return fill_m_[block_of(i, j)]; }

 private:
  std::size_t block_of(std::int64_t i, std::int64_t j) const {
    return static_cast<std::size_t>(((j - world_.j0) >> shift_) * across_ + ((i - world_.i0) >> shift_));
  }
  PostWindow world_;
  int shift_ = 6;
  std::int64_t across_ = 0, down_ = 0;
  std::vector<std::int64_t> sum_1024_;
  std::vector<std::int64_t> count_;
  std::vector<float> fill_m_;
};

// Fills the void posts of `tile`. `around` holds heights and flags of tile.window grown by kFillReach, cut to
// the world.
void fill_voids(HeightGrid& tile, const HeightGrid& around, const FillBlocks& blocks);

}  // namespace lodestone
