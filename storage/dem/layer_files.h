#pragma once
// Where a layer's files are (layout: layer_store.h) and how its store is opened; shared by the store, ingest
// and verify.

#include <filesystem>
#include <memory>
#include <string>

#include "storage/dem/layer_store.h"
#include "storage/dem/lmdb_env.h"

namespace lodestone {

inline constexpr const char* kInfoKey = "info";
inline constexpr const char* kRoughnessKey = "roughness";
inline constexpr std::int64_t kFormatVersion = 1;

std::filesystem::path layer_directory(const std::filesystem::path& data_dir, const std::string& name);
// The generation directory that CURRENT names. Errors: kInvalidArgument (name), kNotFound (lists the layers),
// kCorrupt.
Result<std::filesystem::path> current_generation(const std::filesystem::path& data_dir,
                                                 const std::string& name);
// Replaces `file` by `text`, synced, by way of a temporary name.
Result<void> replace_file(const std::filesystem::path& file, const std::string& text);
Result<void> sync_directory(const std::filesystem::path& directory);
Result<LayerInfo> read_layer_info(const LmdbEnv& env);
// A store on an environment whose tiles are all there, published or not.
std::shared_ptr<LayerStore> store_on(std::shared_ptr<const LmdbEnv> env, LayerInfo info,
                                     std::string roughness, std::size_t decoded_bytes);

}  // namespace lodestone
