#include "service/app/catalog.h"

#include <fmt/format.h>

#include <vector>

namespace lodestone {
namespace {

template <class Map>
Error no_such(std::string_view what, std::string_view name, const Map& map) {
  std::vector<std::string> names;
  for (const auto& [known, value] : map) names.push_back(known);
  return Error{ErrorCode::kNotFound,
               fmt::format("no {} \"{}\"; there {}", what, name,
                           names.empty() ? std::string("are none yet") : fmt::format("are: {}", fmt::join(names, ", ")))};
}

}  // namespace

Result<std::shared_ptr<const Layer>> Catalog::layer(std::string_view name) const {
  const auto found = layers.find(std::string(name));
  if (found != layers.end()) return found->second;
  if (const auto broken = closed.find(std::string(name)); broken != closed.end()) return broken->second;
  return no_such("layer", name, layers);
}

Result<const Recipe*> Catalog::recipe(std::string_view name) const {
  const auto found = recipes.find(std::string(name));
  if (found == recipes.end()) return no_such("recipe", name, recipes);
  return &found->second;
}

CatalogKeeper::CatalogKeeper(const Options& options)
    : data_dir_(options.data_dir),
      decoded_bytes_(static_cast<std::size_t>(options.decoded_cache_mib) << 20),
      model_bytes_(static_cast<std::size_t>(options.model_cache_mib) << 20),
      current_(std::make_shared<Catalog>(Catalog{.recipes = options.recipes})) {}

std::shared_ptr<const Catalog> CatalogKeeper::current() const {
  const std::lock_guard lock(mutex_);
  return current_;
}

void CatalogKeeper::publish(Catalog next) {
  const std::lock_guard lock(mutex_);
  next.version = current_->version + 1;
  current_ = std::make_shared<const Catalog>(std::move(next));
}

Result<std::shared_ptr<const Layer>> CatalogKeeper::open(const std::string& name) const {
  auto layer = Layer::open(data_dir_, name, decoded_bytes_, model_bytes_);
  if (!layer) return layer.error();
  const auto before = current();
  if (const auto old = before->layers.find(name); old != before->layers.end() && old->second->revision() == (*layer)->revision()) {
    return old->second;
  }
  return layer;
}

void CatalogKeeper::reload_layers() {
  const std::lock_guard lock(writer_mutex_);
  const auto before = current();
  Catalog next{.recipes = before->recipes};
  for (const std::string& name : list_layers(data_dir_)) {
    auto layer = open(name);
    if (layer) {
      next.layers.emplace(name, *layer);
      continue;
    }
    next.problems.push_back(fmt::format("layer {}: {}", name, layer.error().message));
    if (const auto old = before->layers.find(name); old != before->layers.end()) {
      next.layers.emplace(name, old->second);
      continue;
    }
    // The layer is there, so "not found" would be a lie that clients and caches believe.
    const bool is_transient = layer.error().code == ErrorCode::kIo;
    next.closed.emplace(name, Error{is_transient ? ErrorCode::kIo : ErrorCode::kCorrupt, next.problems.back()});
  }
  publish(std::move(next));
}

Result<void> CatalogKeeper::reload_layer(const std::string& name) {
  const std::lock_guard lock(writer_mutex_);
  auto layer = open(name);
  if (!layer) return layer.error();
  Catalog next = *current();
  next.layers[name] = *layer;
  next.closed.erase(name);
  publish(std::move(next));
  return {};
}

void CatalogKeeper::set_recipes(const std::map<std::string, Recipe>& recipes) {
  const std::lock_guard lock(writer_mutex_);
  Catalog next = *current();
  next.recipes = recipes;
  publish(std::move(next));
}

}  // namespace lodestone
