#include "kernels/texture/isodata.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace lodestone {

namespace {

double distance2(const Colour& a, const Colour& b) {
  double sum = 0;
  for (std::size_t c = 0; c < 3; ++c) sum += (a[c] - b[c]) * (a[c] - b[c]);
  return sum;
}

struct Cluster {
  Colour centre{}, sum{}, sum2{};
  double distance = 0;   // sum of distances to the centre
  std::size_t size = 0;

  Colour sd() const {
    Colour result{};
    for (std::size_t c = 0; c < 3; ++c) {
      const double mean = sum[c] / static_cast<double>(size);
      result[c] = std::sqrt(std::max(0.0, sum2[c] / static_cast<double>(size) - mean * mean));
    }
    return result;
  }
};

class Isodata {
 public:
  Isodata(std::span<const Colour> samples, const IsodataOptions& options) : samples_(samples), options_(options), labels_(samples.size(), 0) { start(); }

  Clusters run() {
    for (int iteration = 1; iteration <= options_.iterations; ++iteration) {
      bool has_changed = assign();
      if (drop_small()) {
        assign();
        has_changed = true;
      }
      update();
      bool has_split = false;
      if (iteration < options_.iterations) has_split = split();
      const bool has_merged = !has_split && merge();
      if (!has_changed && !has_split && !has_merged) break;
    }
    assign();
    if (drop_small()) assign();
    update();
    Clusters result;
    for (const Cluster& cluster : clusters_) result.centres.push_back(cluster.centre);
    result.labels = std::move(labels_);
    return result;
  }

 private:
  void start() {
    Cluster all;
    for (const Colour& s : samples_) add(all, s);
    all.size = std::max<std::size_t>(samples_.size(), 1);
    const Colour sd = all.sd();
    for (int k = 0; k < options_.start_clusters; ++k) {
      const double t = options_.start_clusters > 1 ? -1.5 + 3.0 * k / (options_.start_clusters - 1) : 0;
      Cluster cluster;
      for (std::size_t c = 0; c < 3; ++c) cluster.centre[c] = all.sum[c] / static_cast<double>(all.size) + t * sd[c];
      clusters_.push_back(cluster);
    }
  }

  static void add(Cluster& cluster, const Colour& s) {
    ++cluster.size;
    for (std::size_t c = 0; c < 3; ++c) {
      cluster.sum[c] += s[c];
      cluster.sum2[c] += s[c] * s[c];
    }
  }

  // Nearest centre of every sample; sums follow. True when a label changed.
  bool assign() {
    for (Cluster& cluster : clusters_) cluster.sum = cluster.sum2 = {}, cluster.distance = 0, cluster.size = 0;
    bool has_changed = false;
    for (std::size_t i = 0; i < samples_.size(); ++i) {
      double nearest = std::numeric_limits<double>::infinity();
      std::size_t label = 0;
      for (std::size_t k = 0; k < clusters_.size(); ++k) {
        const double d = distance2(samples_[i], clusters_[k].centre);
        if (d < nearest) nearest = d, label = k;
      }
      has_changed |= labels_[i] != label;
      labels_[i] = static_cast<std::uint16_t>(label);
      add(clusters_[label], samples_[i]);
    }
    return has_changed;
  }

  // Keeps the largest when all are small.
  bool drop_small() {
    const auto largest = std::max_element(clusters_.begin(), clusters_.end(), [](const Cluster& a, const Cluster& b) { return a.size < b.size; });
    const std::size_t least = std::min(options_.min_size, largest->size);
    const std::size_t before = clusters_.size();
    std::erase_if(clusters_, [&](const Cluster& c) { return c.size < std::max<std::size_t>(least, 1); });
    return clusters_.size() != before;
  }

  void update() {
    for (Cluster& cluster : clusters_) {
      for (std::size_t c = 0; c < 3 && cluster.size > 0; ++c) cluster.centre[c] = cluster.sum[c] / static_cast<double>(cluster.size);
    }
    for (std::size_t i = 0; i < samples_.size(); ++i) clusters_[labels_[i]].distance += std::sqrt(distance2(samples_[i], clusters_[labels_[i]].centre));
  }

  bool split() {
    double total = 0;
    for (const Cluster& cluster : clusters_) total += cluster.distance;
    const double overall = total / static_cast<double>(std::max<std::size_t>(samples_.size(), 1));
    const std::size_t count = clusters_.size();
    bool has_split = false;
    for (std::size_t k = 0; k < count && clusters_.size() < static_cast<std::size_t>(2 * options_.wanted_clusters); ++k) {
      const Cluster cluster = clusters_[k];
      if (cluster.size <= 2 * (options_.min_size + 1)) continue;
      const Colour sd = cluster.sd();
      const std::size_t widest = static_cast<std::size_t>(std::max_element(sd.begin(), sd.end()) - sd.begin());
      if (!(sd[widest] > options_.split_std)) continue;
      const bool is_wide = cluster.distance / static_cast<double>(cluster.size) > overall;
      if (!is_wide && 2 * count > static_cast<std::size_t>(options_.wanted_clusters)) continue;
      Cluster upper = cluster;
      upper.centre[widest] += 0.5 * sd[widest];
      clusters_[k].centre[widest] -= 0.5 * sd[widest];
      clusters_.push_back(upper);
      has_split = true;
    }
    return has_split;
  }

  bool merge() {
    struct Pair {
      double distance2;
      std::size_t a, b;
    };
    std::vector<Pair> pairs;
    for (std::size_t a = 0; a < clusters_.size(); ++a) {
      for (std::size_t b = a + 1; b < clusters_.size(); ++b) {
        const double d = distance2(clusters_[a].centre, clusters_[b].centre);
        if (d < options_.merge_distance * options_.merge_distance) pairs.push_back({d, a, b});
      }
    }
    std::stable_sort(pairs.begin(), pairs.end(), [](const Pair& x, const Pair& y) { return x.distance2 < y.distance2; });
    std::vector<bool> is_used(clusters_.size(), false), is_gone(clusters_.size(), false);
    int merged = 0;
    for (const Pair& pair : pairs) {
      if (merged == 2) break;
      if (is_used[pair.a] || is_used[pair.b]) continue;
      is_used[pair.a] = is_used[pair.b] = is_gone[pair.b] = true;
      Cluster &a = clusters_[pair.a], &b = clusters_[pair.b];
      const double wa = static_cast<double>(a.size), wb = static_cast<double>(b.size);
      for (std::size_t c = 0; c < 3; ++c) a.centre[c] = (a.centre[c] * wa + b.centre[c] * wb) / std::max(wa + wb, 1.0);
      ++merged;
    }
    std::vector<Cluster> left;
    for (std::size_t k = 0; k < clusters_.size(); ++k) {
      if (!is_gone[k]) left.push_back(clusters_[k]);
    }
    clusters_ = std::move(left);
    return merged > 0;
  }

  std::span<const Colour> samples_;
  IsodataOptions options_;
  std::vector<Cluster> clusters_;
  std::vector<std::uint16_t> labels_;
};

}  // namespace

Clusters isodata(std::span<const Colour> samples, const IsodataOptions& options) {
  if (samples.empty()) return {};
  return Isodata(samples, options).run();
}

}  // namespace lodestone
