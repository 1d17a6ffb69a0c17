#include "storage/cache/cache_entry.h"

#include <xxhash.h>

#include <bit>
#include <cstring>

namespace lodestone {
namespace {

static_assert(std::endian::native == std::endian::little, "the cache's numbers are stored little-endian");

std::uint64_t value_checksum(std::string_view key, const char* head, std::string_view body) {
  // The body is hashed in one go; key and head seed it through their own hash.
  char small[kKeyBytes + kValueHeadBytes - 8];
  std::memcpy(small, key.data(), kKeyBytes);
  std::memcpy(small + kKeyBytes, head + 8, kValueHeadBytes - 8);
  return XXH3_64bits_withSeed(body.data(), body.size(), XXH3_64bits(small, sizeof small));
}

std::uint32_t row_checksum(std::string_view key, std::string_view row) {
  const XXH64_hash_t seed = XXH3_64bits(key.data(), key.size());
  return static_cast<std::uint32_t>(XXH3_64bits_withSeed(row.data() + 4, row.size() - 4, seed));
}

}  // namespace

std::string bytes_of_key(const CacheKey& key) {
  std::string bytes(kKeyBytes, '\0');
  for (int i = 0; i < 8; ++i) {
    bytes[i] = static_cast<char>(key.hi >> (56 - 8 * i));
    bytes[8 + i] = static_cast<char>(key.lo >> (56 - 8 * i));
  }
  return bytes;
}

CacheKey key_of_bytes(std::string_view bytes) {
  CacheKey key;
  for (int i = 0; i < 8; ++i) {
    key.hi = key.hi << 8 | static_cast<unsigned char>(bytes[i]);
    key.lo = key.lo << 8 | static_cast<unsigned char>(bytes[8 + i]);
  }
  return key;
}

void make_value_head(std::string_view key, const CachedTile& tile, char (&head)[kValueHeadBytes]) {
  std::memset(head, 0, sizeof head);
  std::memcpy(head + 8, &tile.max_error_m, sizeof tile.max_error_m);
  head[12] = static_cast<char>(tile.provenance);
  const std::uint64_t checksum = value_checksum(key, head, tile.body);
  std::memcpy(head, &checksum, sizeof checksum);
}

bool read_value_head(std::string_view key, const char* head, CachedTile& tile) {
  std::uint64_t checksum = 0;
  std::memcpy(&checksum, head, sizeof checksum);
  if (checksum != value_checksum(key, head, tile.body)) return false;
  std::memcpy(&tile.max_error_m, head + 8, sizeof tile.max_error_m);
  tile.provenance = static_cast<std::uint8_t>(head[12]);
  return true;
}

std::string bytes_of_row(std::string_view key, const CacheRow& row) {
  std::string bytes(kRowHeadBytes, '\0');
  const auto tag_bytes = static_cast<std::uint16_t>(row.tag.size());
  std::memcpy(bytes.data() + 4, &row.charge, sizeof row.charge);
  bytes[8] = static_cast<char>(row.clock);
  std::memcpy(bytes.data() + 10, &tag_bytes, sizeof tag_bytes);
  bytes += row.tag;
  const std::uint32_t checksum = row_checksum(key, bytes);
  std::memcpy(bytes.data(), &checksum, sizeof checksum);
  return bytes;
}

bool row_of_bytes(std::string_view key, std::string_view bytes, CacheRow& row) {
  if (bytes.size() < kRowHeadBytes) return false;
  std::uint32_t checksum = 0;
  std::uint16_t tag_bytes = 0;
  std::memcpy(&checksum, bytes.data(), sizeof checksum);
  std::memcpy(&tag_bytes, bytes.data() + 10, sizeof tag_bytes);
  if (checksum != row_checksum(key, bytes) || kRowHeadBytes + tag_bytes != bytes.size()) return false;
  std::memcpy(&row.charge, bytes.data() + 4, sizeof row.charge);
  row.clock = static_cast<std::uint8_t>(bytes[8]);
  row.tag = bytes.substr(kRowHeadBytes);
  return true;
}

}  // namespace lodestone
