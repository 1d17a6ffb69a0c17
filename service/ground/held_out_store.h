#pragma once
// HeldOutStore: a layer whose finest levels are hidden, so that synthesis has to make them again (lodestone evaluate).

#include <memory>

#include "storage/dem/layer_store.h"

namespace lodestone {

class HeldOutStore final : public LayerStore {
 public:
  // levels: 1..base_level of `full`. The coarse levels are the stored analysis levels; variances of the hidden ones are dropped.
  HeldOutStore(std::shared_ptr<const LayerStore> full, int levels);

  const LayerInfo& info() const override { return info_; }
  std::string roughness_json() const override { return {}; }
  Result<HeightGrid> read_window(int level, const PostWindow& window) const override { return full_->read_window(level, window); }
  Result<bool> has_voids(const PostWindow& window) const override;
  std::uint64_t corrupt_values() const override { return full_->corrupt_values(); }

 private:
  const std::shared_ptr<const LayerStore> full_;
  LayerInfo info_;
};

}  // namespace lodestone
