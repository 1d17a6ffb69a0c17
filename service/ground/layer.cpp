#include "service/ground/layer.h"

#include <fmt/format.h>
#define XXH_INLINE_ALL
#include <xxhash.h>

#include <algorithm>

#include "kernels/device/device.h"

namespace lodestone {
namespace {

constexpr std::int64_t kBlockEntries = 64;
// Raised when the bytes of a tile change for a reason that no other part of the revision knows.
constexpr int kFormatVersion = 1;

std::size_t charge(const std::array<SigmaMap, 3>& maps) {
  std::size_t bytes = 512;
  for (const SigmaMap& map : maps) bytes += (map.s0.size() + map.q.size()) * sizeof(float);
  return bytes;
}

}  // namespace

Result<SigmaMapCache::Block> SigmaMapCache::block(const LayerStore& store, const RoughnessModel& model, std::int64_t x,
                                                  std::int64_t y) {
  const BlockKey key{&model, x, y};
  {
    const std::lock_guard lock(mutex_);
    if (const auto found = index_.find(key); found != index_.end()) {
      recent_.splice(recent_.begin(), recent_, found->second);
      return found->second->second;
    }
  }
  // Two threads may compute the same block at once; both get the same bits and the second one's is dropped.
  const PostWindow entries{x * kBlockEntries, y * kBlockEntries, (x + 1) * kBlockEntries - 1, (y + 1) * kBlockEntries - 1};
  auto steps = analysis_steps(store, entries, model.parameters);
  if (!steps) return steps.error();
  auto maps = std::make_shared<const std::array<SigmaMap, 3>>(
      lsa_maps(entries, store.info().world, *steps, model.fits, model.parameters));
  const std::lock_guard lock(mutex_);
  if (const auto found = index_.find(key); found != index_.end()) return found->second->second;
  recent_.emplace_front(key, maps);
  index_[key] = recent_.begin();
  charged_bytes_ += charge(*maps);
  while (charged_bytes_ > budget_bytes_ && recent_.size() > 1) {
    charged_bytes_ -= charge(*recent_.back().second);
    index_.erase(recent_.back().first);
    recent_.pop_back();
  }
  return Block(maps);
}

Result<std::array<SigmaMap, 3>> SigmaMapCache::crop(const LayerStore& store, const RoughnessModel& model,
                                                    const std::array<PostWindow, 3>& windows) {
  std::array<SigmaMap, 3> out;
  PostWindow blocks{INT64_MAX, INT64_MAX, INT64_MIN, INT64_MIN};
  for (int band = 0; band < 3; ++band) {
    const PostWindow& w = windows[band];
    const auto size = sigma_map_size(store.info().world, band);
    SigmaMap& map = out[band];
    map.i0 = w.i0;
    map.j0 = w.j0;
    map.map_width = size[0];
    map.map_height = size[1];
    if (w.is_empty()) continue;
    map.width = static_cast<int>(w.width());
    map.height = static_cast<int>(w.height());
    map.s0.resize(static_cast<std::size_t>(w.width() * w.height()));
    map.q.resize(map.s0.size());
    blocks = {std::min(blocks.i0, w.i0 / kBlockEntries), std::min(blocks.j0, w.j0 / kBlockEntries),
              std::max(blocks.i1, w.i1 / kBlockEntries), std::max(blocks.j1, w.j1 / kBlockEntries)};
  }
  for (std::int64_t y = blocks.j0; y <= blocks.j1; ++y) {
    for (std::int64_t x = blocks.i0; x <= blocks.i1; ++x) {
      auto part = block(store, model, x, y);
      if (!part) return part.error();
      for (int band = 0; band < 3; ++band) {
        const SigmaMap& from = (**part)[band];
        SigmaMap& to = out[band];
        const std::int64_t i0 = std::max(from.i0, to.i0);
        const std::int64_t i1 = std::min(from.i0 + from.width, to.i0 + to.width);
        if (i0 >= i1) continue;
        const std::int64_t j1 = std::min(from.j0 + from.height, to.j0 + to.height);
        for (std::int64_t j = std::max(from.j0, to.j0); j < j1; ++j) {
          const std::size_t source = static_cast<std::size_t>((j - from.j0) * from.width + (i0 - from.i0));
          const std::size_t target = static_cast<std::size_t>((j - to.j0) * to.width + (i0 - to.i0));
          std::copy_n(&from.s0[source], i1 - i0, &to.s0[target]);
          std::copy_n(&from.q[source], i1 - i0, &to.q[target]);
        }
      }
    }
  }
  return out;
}

Result<std::shared_ptr<const Layer>> Layer::open(const std::filesystem::path& data_dir, const std::string& name,
                                                 std::size_t decoded_bytes, std::size_t model_bytes) {
  auto store = LayerStore::open(data_dir, name, decoded_bytes);
  if (!store) return store.error();
  auto masks = MaskStore::open(data_dir, (*store)->info());
  if (!masks) return masks.error();
  auto crs = CrsTransform::create((*store)->info().crs_wkt);
  if (!crs) return std::move(crs.error()).within("opening layer " + name);
  const std::shared_ptr<Layer> layer(new Layer(*store, *masks, *crs, model_bytes));
  const std::string stored = (*store)->roughness_json();
  if (!stored.empty()) {
    auto models = models_from_json(stored);
    if (!models) return std::move(models.error()).within("opening layer " + name);
    for (const RoughnessModel& model : *models) layer->models_.push_back(std::make_shared<const RoughnessModel>(model));
  }
  return std::shared_ptr<const Layer>(layer);
}

Result<std::shared_ptr<const Layer>> Layer::over(std::shared_ptr<LayerStore> store, std::size_t model_bytes) {
  auto crs = CrsTransform::create(store->info().crs_wkt);
  if (!crs) return crs.error();
  return std::shared_ptr<const Layer>(new Layer(std::move(store), nullptr, *crs, model_bytes));
}

Layer::Layer(std::shared_ptr<LayerStore> store, std::shared_ptr<MaskStore> masks, std::shared_ptr<CrsTransform> crs,
             std::size_t model_bytes)
    : store_(std::move(store)), masks_(std::move(masks)), crs_(std::move(crs)), mask_list_(masks_ ? masks_->list() : std::vector<MaskInfo>()), sigma_maps_(model_bytes) {
  const std::string text = fmt::format("{}|{}|{}|{}|{}", kFormatVersion, layer_info_json(info()), store_->roughness_json(),
                                       masks_ ? masks_->digest() : 0, kernel_source_hash());
  revision_ = fmt::format("{:016x}", XXH3_64bits(text.data(), text.size()));
}

Result<std::shared_ptr<const RoughnessModel>> Layer::model(const LsaParameters& parameters) const {
  const std::lock_guard lock(mutex_);
  for (const auto& model : models_) {
    if (model->parameters == parameters) return model;
  }
  auto computed = compute_models(*store_, std::span(&parameters, 1), 1);
  if (!computed) return computed.error();
  models_.push_back(std::make_shared<const RoughnessModel>(computed->front()));
  return models_.back();
}

std::vector<std::string> Layer::resolve_masks(const std::vector<std::string>& names) const {
  std::vector<std::string> out;
  for (const std::string& name : names) {
    if (name == "*") {
      for (const MaskInfo& mask : mask_list_) out.push_back(mask.name);
      continue;
    }
    const bool is_known = std::any_of(mask_list_.begin(), mask_list_.end(), [&](const MaskInfo& m) { return m.name == name; });
    if (is_known) out.push_back(name);
  }
  std::sort(out.begin(), out.end());
  out.erase(std::unique(out.begin(), out.end()), out.end());
  return out;
}

}  // namespace lodestone
