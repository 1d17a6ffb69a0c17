#pragma once
// The bytes of a cache entry: its key, its value in the "blobs" database and its row in the "rows" database (storage/FORMAT-CACHE.md).

#include <cstdint>
#include <string>
#include <string_view>

#include "storage/cache/memory_cache.h"

namespace lodestone {

constexpr std::size_t kKeyBytes = 16;
constexpr std::size_t kValueHeadBytes = 16;
constexpr std::size_t kRowHeadBytes = 12;
constexpr std::uint8_t kMaxClock = 3;

std::string bytes_of_key(const CacheKey& key);  // big-endian, so that the bytewise order is the numeric one
CacheKey key_of_bytes(std::string_view bytes);  // needs kKeyBytes

// The value's head: checksum over key, rest of the head and body; then what the headers of the answer need.
void make_value_head(std::string_view key, const CachedTile& tile, char (&head)[kValueHeadBytes]);
// False when the checksum does not fit. Sets everything of `tile` but its body, which must be there already.
bool read_value_head(std::string_view key, const char* head, CachedTile& tile);

struct CacheRow {
  std::uint32_t charge = 0;  // bytes
  std::uint8_t clock = 0;    // turns of the clock that the entry survives
  std::string_view tag;
};
std::string bytes_of_row(std::string_view key, const CacheRow& row);
bool row_of_bytes(std::string_view key, std::string_view bytes, CacheRow& row);  // false: fails its checksum

}  // namespace lodestone
