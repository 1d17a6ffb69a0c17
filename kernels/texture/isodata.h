#pragma once
// ISODATA clustering of colours without random numbers. Source: Abasolo sec. 4 names the algorithm; parameters are ours.

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

namespace lodestone {

using Colour = std::array<double, 3>;

struct IsodataOptions {
  int start_clusters = 8;        // centres spread evenly over mean +- 1.5 sd
  int wanted_clusters = 8;       // at most half of it: always split; never more than twice of it
  double split_std = 24;         // a cluster with a channel sd above it may be split
  double merge_distance = 24;    // centres nearer than this may be merged, two pairs an iteration
  std::size_t min_size = 4;      // smaller clusters are dissolved
  int iterations = 12;           // the last one only merges
};

struct Clusters {
  std::vector<Colour> centres;          // means of their samples; at least one unless there are no samples
  std::vector<std::uint16_t> labels;    // per sample
};
// Ties go to the lower index everywhere, so the result is a pure function of samples and options.
Clusters isodata(std::span<const Colour> samples, const IsodataOptions& options);

}  // namespace lodestone
