#pragma once
// Layer: an opened layer as the daemon uses it: heights, masks, roughness, revision. Immutable but for its caches; a change
// of masks or data makes a new one.

#include <list>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <unordered_map>

#include "service/config/recipe.h"
#include "service/ground/roughness_models.h"
#include "storage/dem/crs_transform.h"
#include "storage/dem/layer_store.h"
#include "storage/dem/mask_store.h"

namespace lodestone {

// Maps of local roughness, computed in blocks when first asked for. Thread-safe; bounded in bytes (least recently used goes).
class SigmaMapCache {
 public:
  explicit SigmaMapCache(std::size_t budget_bytes) : budget_bytes_(budget_bytes) {}

  // The rectangle `windows[band]` (local entries, inside the map) of each band. Errors: those of read_window.
  Result<std::array<SigmaMap, 3>> crop(const LayerStore& store, const RoughnessModel& model,
                                       const std::array<PostWindow, 3>& windows);

 private:
  struct BlockKey {
    const void* model;
    std::int64_t x, y;
    auto operator<=>(const BlockKey&) const = default;
  };
  using Block = std::shared_ptr<const std::array<SigmaMap, 3>>;
  Result<Block> block(const LayerStore& store, const RoughnessModel& model, std::int64_t x, std::int64_t y);

  const std::size_t budget_bytes_;
  std::mutex mutex_;  // guards all below
  std::list<std::pair<BlockKey, Block>> recent_;
  std::map<BlockKey, std::list<std::pair<BlockKey, Block>>::iterator> index_;
  std::size_t charged_bytes_ = 0;
};

class Layer {
 public:
  // Opens store and masks of `name` below data_dir. Errors: those of LayerStore::open and MaskStore::open.
  static Result<std::shared_ptr<const Layer>> open(const std::filesystem::path& data_dir, const std::string& name,
                                                   std::size_t decoded_bytes, std::size_t model_bytes);

  // A layer without masks over any store (evaluation, tests). Error: the store's CRS is not understood.
  static Result<std::shared_ptr<const Layer>> over(std::shared_ptr<LayerStore> store, std::size_t model_bytes);

  const LayerInfo& info() const { return store_->info(); }
  const LayerStore& store() const { return *store_; }
  MaskStore& masks() const { return *masks_; }  // not of a layer made by over()
  // 16 hexadecimal digits over source data, grid, options, masks, kernel and format version.
  const std::string& revision() const { return revision_; }
  const std::vector<MaskInfo>& mask_list() const { return mask_list_; }

  // The model for these parameters: stored with the layer, or computed now and kept.
  Result<std::shared_ptr<const RoughnessModel>> model(const LsaParameters& parameters) const;
  SigmaMapCache& sigma_maps() const { return sigma_maps_; }
  CrsTransform& crs() const { return *crs_; }

  // The layer's masks that a recipe names ("*": all), sorted. Names that the layer does not have are left out: one recipe
  // serves layers with and without roads.
  std::vector<std::string> resolve_masks(const std::vector<std::string>& names) const;

 private:
  Layer(std::shared_ptr<LayerStore> store, std::shared_ptr<MaskStore> masks, std::shared_ptr<CrsTransform> crs,
        std::size_t model_bytes);

  const std::shared_ptr<LayerStore> store_;
  const std::shared_ptr<MaskStore> masks_;  // null: over()
  const std::shared_ptr<CrsTransform> crs_;
  std::vector<MaskInfo> mask_list_;
  std::string revision_;
  mutable SigmaMapCache sigma_maps_;
  mutable std::mutex mutex_;  // guards models_
  mutable std::vector<std::shared_ptr<const RoughnessModel>> models_;
};

}  // namespace lodestone
