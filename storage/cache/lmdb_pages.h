#pragma once
// Reads LMDB's data file (format 1, LMDB 0.9) with pread and checks every byte that it relies on. LMDB itself trusts its pages: a
// flipped bit or a file cut short ends in a signal. So tiles are read through this, and a file is checked by it before LMDB opens it.
// Source: the layouts of MDB_meta, MDB_db, MDB_page and MDB_node in mdb.c of LMDB 0.9.24; see storage/FORMAT-CACHE.md.

#include <cstddef>
#include <cstdint>
#include <functional>
#include <string>
#include <string_view>

namespace lodestone {

// What became of a read. kDamaged: the structure breaks a rule (or the file is too short); kReadError: the disk said no (errno).
enum class PageStatus { kOk, kAbsent, kDamaged, kReadError };

// One B-tree, as LMDB's MDB_db.
struct LmdbTree {
  std::uint32_t page_size = 0;  // of the free tree only
  std::uint16_t flags = 0;
  std::uint16_t depth = 0;
  std::uint64_t branch_pages = 0, leaf_pages = 0, overflow_pages = 0, entries = 0;
  std::uint64_t root = 0;  // all ones: empty
};

// One committed state of the file, as LMDB's MDB_meta.
struct LmdbSnapshot {
  std::uint64_t txn_id = 0;
  std::uint64_t last_page = 0;
  LmdbTree free_tree, main_tree;
};

// One node of a leaf. A large value lies in its own pages: a 16-byte page header, then `size` bytes.
struct LmdbNode {
  std::string_view key;
  std::string_view value;        // empty when is_large
  std::uint16_t flags = 0;
  bool is_large = false;
  std::uint64_t size = 0;        // of the value
  std::uint64_t first_page = 0;  // when is_large
};

// Thread-safe. Does not own the descriptor.
class LmdbPages {
 public:
  static constexpr std::size_t kHeaderBytes = 16;      // of a page
  static constexpr std::size_t kMaxPageBytes = 65536;

  LmdbPages() = default;
  LmdbPages(int fd, std::size_t page_bytes) : fd_(fd), page_bytes_(page_bytes) {}

  std::size_t page_bytes() const { return page_bytes_; }
  std::uint64_t pages_of(std::uint64_t value_bytes) const { return (kHeaderBytes + value_bytes + page_bytes_ - 1) / page_bytes_; }

  // The last committed state, or the one numbered `txn_id` (kAbsent when it has been overwritten meanwhile).
  PageStatus newest(LmdbSnapshot& snapshot) const;
  PageStatus numbered(std::uint64_t txn_id, LmdbSnapshot& snapshot) const;

  // The tree of a named database in the main tree.
  PageStatus named_tree(const LmdbSnapshot& snapshot, std::string_view name, LmdbTree& tree) const;

  // Looks a key up (bytewise order). `page` receives the leaf that `node` points into; kMaxPageBytes long.
  PageStatus find(const LmdbSnapshot& snapshot, const LmdbTree& tree, std::string_view key, char* page, LmdbNode& node) const;

  // Reads a large value's page header and its first `head_bytes` + `body_bytes` bytes. kDamaged when the page header is wrong.
  PageStatus read_large(const LmdbNode& node, char* head, std::size_t head_bytes, char* body, std::size_t body_bytes) const;

  // Writes the page header of a large value anew if it is not what it must be (LMDB frees as many pages as it says).
  PageStatus mend_large(const LmdbNode& node) const;

  // Walks the free tree, the main tree and the databases named in it: bounds, order, counts, no page used twice, all pages within the
  // file. `visit` is given each node of each named database, in order; false from it means damage. `reason` says what broke.
  using Visit = std::function<bool(std::string_view database, const LmdbNode& node)>;
  PageStatus check(const LmdbSnapshot& snapshot, const Visit& visit, std::string& reason) const;

 private:
  friend class LmdbWalk;
  PageStatus read_at(std::uint64_t offset, void* out, std::size_t bytes) const;
  PageStatus read_page(const LmdbSnapshot& snapshot, std::uint64_t number, char* page) const;
  PageStatus metas(LmdbSnapshot (&out)[2]) const;

  int fd_ = -1;
  std::size_t page_bytes_ = 4096;
};

}  // namespace lodestone
