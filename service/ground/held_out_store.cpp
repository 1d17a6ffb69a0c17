#include "service/ground/held_out_store.h"

#include <cassert>
#include <cmath>

namespace lodestone {

HeldOutStore::HeldOutStore(std::shared_ptr<const LayerStore> full, int levels) : full_(std::move(full)), info_(full_->info()) {
  assert(levels >= 1 && levels <= info_.base_level && "more levels held out than the layer has");
  info_.world = full_->info().world_at(info_.base_level - levels);
  info_.base_level -= levels;
  for (const int n : {1, 2, 4, 5}) info_.transform[n] = std::ldexp(info_.transform[n], levels);
  info_.cell_x_m = std::ldexp(info_.cell_x_m, levels);
  info_.cell_y_m = std::ldexp(info_.cell_y_m, levels);
  const auto dropped = std::min<std::size_t>(static_cast<std::size_t>(levels), info_.variances.size());
  info_.variances.erase(info_.variances.begin(), info_.variances.begin() + static_cast<std::ptrdiff_t>(dropped));
}

Result<bool> HeldOutStore::has_voids(const PostWindow& window) const {
  auto grid = full_->read_window(info_.base_level, window);
  if (!grid) return grid.error();
  return !grid->is_void.empty();
}

}  // namespace lodestone
