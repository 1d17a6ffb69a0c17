#pragma once
// What ingest and verify do with a layer's masks.

#include <filesystem>

#include "storage/dem/layer_store.h"

namespace lodestone {

// Warps masks to the grid of `layer` from their sources, and drops those of grids other than it and
// `previous` (may be null). The layer's lock must be held.
Result<void> rewarp_masks(const std::filesystem::path& data_dir, const LayerInfo& layer,
                          const LayerInfo* previous);
// Checks every stored value of the layer's masks and adds to the report.
void verify_masks(const std::filesystem::path& data_dir, const LayerInfo& layer, VerifyReport& report);

}  // namespace lodestone
