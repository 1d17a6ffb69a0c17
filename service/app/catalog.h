#pragma once
// Catalog: the layers and recipes in force, as an immutable snapshot; a reload or a mask change makes the next one.

#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <vector>

#include "service/config/options.h"
#include "service/ground/layer.h"

namespace lodestone {

struct Catalog {
  std::uint64_t version = 0;  // grows with every change
  std::map<std::string, std::shared_ptr<const Layer>> layers;
  std::map<std::string, Recipe> recipes;
  std::vector<std::string> problems;  // layers that did not open, with the reason
  std::map<std::string, Error> closed;  // the same, by name; without those of which an older state is still served

  // Errors: kNotFound, lists the names that exist; kCorrupt or kIo for a layer that is there but does not open.
  Result<std::shared_ptr<const Layer>> layer(std::string_view name) const;
  Result<const Recipe*> recipe(std::string_view name) const;
};

// Thread-safe.
class CatalogKeeper {
 public:
  explicit CatalogKeeper(const Options& options);

  std::shared_ptr<const Catalog> current() const;
  // Opens all layers below the data directory anew; those whose generation and masks are unchanged keep their caches.
  // A layer that does not open is left out, and told in `problems`; if it was open before, the old one stays.
  void reload_layers();
  // One layer anew, after its masks or data changed.
  Result<void> reload_layer(const std::string& name);
  void set_recipes(const std::map<std::string, Recipe>& recipes);

 private:
  Result<std::shared_ptr<const Layer>> open(const std::string& name) const;
  void publish(Catalog next);

  const std::string data_dir_;
  const std::size_t decoded_bytes_, model_bytes_;
  std::mutex writer_mutex_;     // one change at a time
  mutable std::mutex mutex_;    // guards current_
  std::shared_ptr<const Catalog> current_;
};

}  // namespace lodestone
