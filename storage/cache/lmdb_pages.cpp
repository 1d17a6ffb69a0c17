#include "storage/cache/lmdb_pages.h"

#include <sys/uio.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <vector>

namespace lodestone {
namespace {

constexpr std::uint32_t kMagic = 0xBEEFC0DE;
constexpr std::uint32_t kDataVersion = 1;
constexpr std::uint16_t kPageBranch = 1, kPageLeaf = 2, kPageOverflow = 4, kPageMeta = 8;
constexpr std::uint16_t kNodeLarge = 1, kNodeTree = 2;
constexpr std::uint16_t kTreeIntegerKey = 8;
constexpr std::uint64_t kNoPage = ~std::uint64_t{0};
constexpr std::size_t kNodeHeaderBytes = 8;
constexpr std::size_t kTreeBytes = 48;
constexpr std::size_t kMetaBytes = 136;
constexpr int kMaxDepth = 16;

template <class T>
T load(const char* at) {
  T value;
  std::memcpy(&value, at, sizeof value);
  return value;
}

LmdbTree tree_at(const char* at) {
  LmdbTree tree;
  tree.page_size = load<std::uint32_t>(at);
  tree.flags = load<std::uint16_t>(at + 4);
  tree.depth = load<std::uint16_t>(at + 6);
  tree.branch_pages = load<std::uint64_t>(at + 8);
  tree.leaf_pages = load<std::uint64_t>(at + 16);
  tree.overflow_pages = load<std::uint64_t>(at + 24);
  tree.entries = load<std::uint64_t>(at + 32);
  tree.root = load<std::uint64_t>(at + 40);
  return tree;
}

// A branch or leaf page whose header has been checked.
class PageView {
 public:
  PageView(const char* page, std::size_t page_bytes) : page_(page), page_bytes_(page_bytes) {}

  // The rules of the header alone.
  bool is_sound(std::uint64_t number) const {
    if (load<std::uint64_t>(page_) != number || load<std::uint16_t>(page_ + 8) != 0) return false;
    if (flags() != kPageBranch && flags() != kPageLeaf) return false;
    return lower() >= LmdbPages::kHeaderBytes && lower() % 2 == 0 && lower() <= upper() && upper() <= page_bytes_ && count() > 0;
  }
  std::uint16_t flags() const { return load<std::uint16_t>(page_ + 10); }
  bool is_leaf() const { return flags() == kPageLeaf; }
  std::size_t lower() const { return load<std::uint16_t>(page_ + 12); }
  std::size_t upper() const { return load<std::uint16_t>(page_ + 14); }
  std::size_t count() const { return (lower() - LmdbPages::kHeaderBytes) / 2; }
  std::size_t offset(std::size_t index) const { return load<std::uint16_t>(page_ + LmdbPages::kHeaderBytes + 2 * index); }

  // A node of a branch page: its key and child. False when it reaches outside the page.
  bool branch_node(std::size_t index, std::string_view& key, std::uint64_t& child, std::size_t& node_bytes) const {
    const std::size_t at = offset(index);
    if (at < upper() || at + kNodeHeaderBytes > page_bytes_) return false;
    const std::size_t key_bytes = load<std::uint16_t>(page_ + at + 6);
    node_bytes = kNodeHeaderBytes + key_bytes;
    if (at + node_bytes > page_bytes_) return false;
    child = load<std::uint16_t>(page_ + at) | std::uint64_t{load<std::uint16_t>(page_ + at + 2)} << 16 |
            std::uint64_t{load<std::uint16_t>(page_ + at + 4)} << 32;
    key = {page_ + at + kNodeHeaderBytes, key_bytes};
    return true;
  }

  bool leaf_node(std::size_t index, LmdbNode& node, std::size_t& node_bytes) const {
    const std::size_t at = offset(index);
    if (at < upper() || at + kNodeHeaderBytes > page_bytes_) return false;
    const std::size_t key_bytes = load<std::uint16_t>(page_ + at + 6);
    node.flags = load<std::uint16_t>(page_ + at + 4);
    node.size = load<std::uint16_t>(page_ + at) | std::uint64_t{load<std::uint16_t>(page_ + at + 2)} << 16;
    node.is_large = node.flags & kNodeLarge;
    if (node.flags & ~(kNodeLarge | kNodeTree)) return false;
    const std::size_t inline_bytes = node.is_large ? sizeof(std::uint64_t) : node.size;
    node_bytes = kNodeHeaderBytes + key_bytes + inline_bytes;
    if (key_bytes == 0 || at + node_bytes > page_bytes_) return false;
    node.key = {page_ + at + kNodeHeaderBytes, key_bytes};
    const char* value = page_ + at + kNodeHeaderBytes + key_bytes;
    node.value = node.is_large ? std::string_view{} : std::string_view(value, inline_bytes);
    node.first_page = node.is_large ? load<std::uint64_t>(value) : 0;
    return true;
  }

 private:
  const char* page_;
  std::size_t page_bytes_;
};

int compare(std::string_view a, std::string_view b, bool is_integer) {
  if (!is_integer) return a.compare(b);
  const auto x = load<std::uint64_t>(a.data()), y = load<std::uint64_t>(b.data());
  return x < y ? -1 : x > y;
}

}  // namespace

PageStatus LmdbPages::read_at(std::uint64_t offset, void* out, std::size_t bytes) const {
  std::size_t done = 0;
  while (done < bytes) {
    const ssize_t got = ::pread(fd_, static_cast<char*>(out) + done, bytes - done, static_cast<off_t>(offset + done));
    if (got < 0 && errno == EINTR) continue;
    if (got < 0) return PageStatus::kReadError;
    if (got == 0) return PageStatus::kDamaged;
    done += static_cast<std::size_t>(got);
  }
  return PageStatus::kOk;
}

PageStatus LmdbPages::read_page(const LmdbSnapshot& snapshot, std::uint64_t number, char* page) const {
  if (number < 2 || number > snapshot.last_page) return PageStatus::kDamaged;
  const PageStatus status = read_at(number * page_bytes_, page, page_bytes_);
  if (status != PageStatus::kOk) return status;
  return PageView(page, page_bytes_).is_sound(number) ? PageStatus::kOk : PageStatus::kDamaged;
}

PageStatus LmdbPages::metas(LmdbSnapshot (&out)[2]) const {
  for (std::uint64_t i = 0; i < 2; ++i) {
    char page[kHeaderBytes + kMetaBytes];
    const PageStatus status = read_at(i * page_bytes_, page, sizeof page);
    if (status != PageStatus::kOk) return status;
    const char* meta = page + kHeaderBytes;
    if (load<std::uint64_t>(page) != i || load<std::uint16_t>(page + 10) != kPageMeta || load<std::uint32_t>(meta) != kMagic ||
        load<std::uint32_t>(meta + 4) != kDataVersion) {
      return PageStatus::kDamaged;
    }
    out[i].free_tree = tree_at(meta + 24);
    out[i].main_tree = tree_at(meta + 24 + kTreeBytes);
    out[i].last_page = load<std::uint64_t>(meta + 24 + 2 * kTreeBytes);
    out[i].txn_id = load<std::uint64_t>(meta + 32 + 2 * kTreeBytes);
    const bool is_page_size = out[i].free_tree.page_size == page_bytes_ && out[i].free_tree.flags == kTreeIntegerKey;
    const bool is_slot = out[i].txn_id == 0 || (out[i].txn_id & 1) == i;
    if (!is_page_size || !is_slot || out[i].main_tree.flags != 0 || out[i].last_page < 1 || out[i].last_page > kNoPage / page_bytes_ / 2) {
      return PageStatus::kDamaged;
    }
  }
  return PageStatus::kOk;
}

PageStatus LmdbPages::newest(LmdbSnapshot& snapshot) const {
  LmdbSnapshot both[2];
  const PageStatus status = metas(both);
  if (status == PageStatus::kOk) snapshot = both[both[0].txn_id < both[1].txn_id];
  return status;
}

PageStatus LmdbPages::numbered(std::uint64_t txn_id, LmdbSnapshot& snapshot) const {
  LmdbSnapshot both[2];
  const PageStatus status = metas(both);
  if (status != PageStatus::kOk) return status;
  for (const LmdbSnapshot& one : both) {
    if (one.txn_id == txn_id) {
      snapshot = one;
      return PageStatus::kOk;
    }
  }
  return PageStatus::kAbsent;
}

PageStatus LmdbPages::find(const LmdbSnapshot& snapshot, const LmdbTree& tree, std::string_view key, char* page, LmdbNode& node) const {
  if (tree.root == kNoPage) return PageStatus::kAbsent;
  std::uint64_t number = tree.root;
  for (int depth = 0; depth < kMaxDepth; ++depth) {
    const PageStatus status = read_page(snapshot, number, page);
    if (status != PageStatus::kOk) return status;
    const PageView view(page, page_bytes_);
    std::size_t node_bytes = 0;
    if (!view.is_leaf()) {
      // The last child whose key is not above `key`; the first child's key counts as lowest.
      std::size_t low = 1, high = view.count();
      std::string_view at;
      while (low < high) {
        const std::size_t middle = (low + high) / 2;
        if (!view.branch_node(middle, at, number, node_bytes)) return PageStatus::kDamaged;
        const bool is_above = at.compare(key) > 0;
        (is_above ? high : low) = is_above ? middle : middle + 1;
      }
      if (!view.branch_node(low - 1, at, number, node_bytes)) return PageStatus::kDamaged;
      continue;
    }
    std::size_t low = 0, high = view.count();
    while (low < high) {
      const std::size_t middle = (low + high) / 2;
      if (!view.leaf_node(middle, node, node_bytes)) return PageStatus::kDamaged;
      const int order = node.key.compare(key);
      if (order == 0) return PageStatus::kOk;
      (order < 0 ? low : high) = order < 0 ? middle + 1 : middle;
    }
    return PageStatus::kAbsent;
  }
  return PageStatus::kDamaged;
}

PageStatus LmdbPages::named_tree(const LmdbSnapshot& snapshot, std::string_view name, LmdbTree& tree) const {
  char page[kMaxPageBytes];
  LmdbNode node;
  const PageStatus status = find(snapshot, snapshot.main_tree, name, page, node);
  if (status != PageStatus::kOk) return status;
  if (node.flags != kNodeTree || node.value.size() != kTreeBytes) return PageStatus::kDamaged;
  tree = tree_at(node.value.data());
  return PageStatus::kOk;
}

PageStatus LmdbPages::read_large(const LmdbNode& node, char* head, std::size_t head_bytes, char* body, std::size_t body_bytes) const {
  char header[kHeaderBytes];
  iovec parts[3] = {{header, kHeaderBytes}, {head, head_bytes}, {body, body_bytes}};
  const std::size_t wanted = kHeaderBytes + head_bytes + body_bytes;
  const ssize_t got = ::preadv(fd_, parts, 3, static_cast<off_t>(node.first_page * page_bytes_));
  if (got < 0 && errno != EINTR) return PageStatus::kReadError;
  if (got != static_cast<ssize_t>(wanted)) {
    // Cut short by a signal, or by the end of the file: once more, piece by piece.
    std::uint64_t offset = node.first_page * page_bytes_;
    for (const iovec& part : parts) {
      const PageStatus status = read_at(offset, part.iov_base, part.iov_len);
      if (status != PageStatus::kOk) return status;
      offset += part.iov_len;
    }
  }
  const bool is_sound = load<std::uint64_t>(header) == node.first_page && load<std::uint16_t>(header + 10) == kPageOverflow &&
                        load<std::uint32_t>(header + 12) == pages_of(node.size);
  return is_sound ? PageStatus::kOk : PageStatus::kDamaged;
}

PageStatus LmdbPages::mend_large(const LmdbNode& node) const {
  const PageStatus status = read_large(node, nullptr, 0, nullptr, 0);
  if (status != PageStatus::kDamaged) return status;
  char header[kHeaderBytes] = {};
  const auto pages = static_cast<std::uint32_t>(pages_of(node.size));
  std::memcpy(header, &node.first_page, sizeof node.first_page);
  std::memcpy(header + 10, &kPageOverflow, sizeof kPageOverflow);
  std::memcpy(header + 12, &pages, sizeof pages);
  const ssize_t put = ::pwrite(fd_, header, sizeof header, static_cast<off_t>(node.first_page * page_bytes_));
  return put == static_cast<ssize_t>(sizeof header) ? PageStatus::kOk : PageStatus::kReadError;
}

// One walk over everything that a snapshot reaches.
class LmdbWalk {
 public:
  LmdbWalk(const LmdbPages& pages, const LmdbSnapshot& snapshot, std::uint64_t file_bytes, std::string& reason)
      : pages_(pages), snapshot_(snapshot), file_pages_(file_bytes / pages.page_bytes()), reason_(reason) {
    used_.resize(std::min(snapshot.last_page + 1, file_pages_ + (std::uint64_t{1} << 20)));
  }

  using VisitNode = std::function<PageStatus(const LmdbNode&)>;

  PageStatus tree(const LmdbTree& tree, bool is_integer, const VisitNode& visit) {
    if (tree.root == kNoPage) {
      return tree.entries == 0 && tree.depth == 0 ? PageStatus::kOk : damaged("an empty tree with entries");
    }
    Counts counts;
    const PageStatus status = page(tree, tree.root, 1, {}, {}, is_integer, visit, counts);
    if (status != PageStatus::kOk) return status;
    const bool is_same = counts.branch == tree.branch_pages && counts.leaf == tree.leaf_pages && counts.overflow == tree.overflow_pages &&
                         counts.entries == tree.entries;
    return is_same ? PageStatus::kOk : damaged("a tree's counts differ from what it holds");
  }

  // One record of the free tree: a count, then page numbers downwards.
  PageStatus free_record(const LmdbNode& node) {
    std::string bytes(node.value);
    if (node.is_large) {
      bytes.resize(node.size);
      const PageStatus status = pages_.read_large(node, bytes.data(), bytes.size(), nullptr, 0);
      if (status != PageStatus::kOk) return status == PageStatus::kDamaged ? damaged("a free list's page header") : status;
    }
    if (bytes.size() < 8 || bytes.size() % 8 != 0) return damaged("a free list of odd size");
    const auto count = load<std::uint64_t>(bytes.data());
    if (count > bytes.size() / 8 - 1) return damaged("a free list longer than its record");
    std::uint64_t above = kNoPage;
    for (std::uint64_t i = 1; i <= count; ++i) {
      const auto number = load<std::uint64_t>(bytes.data() + 8 * i);
      if (number >= above || number > snapshot_.last_page) return damaged("a free list out of order");
      above = number;
      if (number < used_.size() && !take(number)) return damaged("a free page that is in use");
    }
    return PageStatus::kOk;
  }

  PageStatus damaged(const char* what) {
    reason_ = what;
    return PageStatus::kDamaged;
  }

 private:
  struct Counts {
    std::uint64_t branch = 0, leaf = 0, overflow = 0, entries = 0;
  };

  bool take(std::uint64_t number) {
    if (number < 2 || number >= used_.size() || used_[number]) return false;
    used_[number] = true;
    return true;
  }

  bool take_in_file(std::uint64_t first, std::uint64_t count) {
    if (first > snapshot_.last_page || count > snapshot_.last_page + 1 - first || first + count > file_pages_) return false;
    for (std::uint64_t i = 0; i < count; ++i) {
      if (!take(first + i)) return false;
    }
    return true;
  }

  // Keys of the page lie in [low, high); empty: no limit.
  PageStatus page(const LmdbTree& tree, std::uint64_t number, int depth, std::string_view low, std::string_view high, bool is_integer,
                  const VisitNode& visit, Counts& counts) {
    if (depth > kMaxDepth || depth > tree.depth) return damaged("a tree deeper than it says");
    if (!take_in_file(number, 1)) return damaged("a page used twice or outside the file");
    std::vector<char> bytes(pages_.page_bytes());
    const PageStatus status = pages_.read_page(snapshot_, number, bytes.data());
    if (status != PageStatus::kOk) return status == PageStatus::kDamaged ? damaged("a page header") : status;
    const PageView view(bytes.data(), pages_.page_bytes());
    if (view.is_leaf() != (depth == tree.depth)) return damaged("a leaf at the wrong depth");
    if (!is_packed(view)) return damaged("nodes that overlap or leave their page");
    return view.is_leaf() ? leaf(view, low, high, is_integer, visit, counts)
                          : branch(tree, view, depth, low, high, is_integer, visit, counts);
  }

  // The nodes fill [upper, end of page) without gap or overlap.
  bool is_packed(const PageView& view) {
    extents_.clear();
    for (std::size_t i = 0; i < view.count(); ++i) {
      std::size_t node_bytes = 0;
      std::string_view key;
      std::uint64_t child = 0;
      LmdbNode node;
      if (!(view.is_leaf() ? view.leaf_node(i, node, node_bytes) : view.branch_node(i, key, child, node_bytes))) return false;
      extents_.emplace_back(view.offset(i), (node_bytes + 1) & ~std::size_t{1});
    }
    std::sort(extents_.begin(), extents_.end());
    std::size_t at = view.upper();
    for (const auto& [offset, size] : extents_) {
      if (offset != at) return false;
      at += size;
    }
    return at == pages_.page_bytes();
  }

  bool is_within(std::string_view key, std::string_view low, std::string_view high, bool is_integer) const {
    if (is_integer && key.size() != 8) return false;
    return (low.empty() || compare(key, low, is_integer) >= 0) && (high.empty() || compare(key, high, is_integer) < 0);
  }

  PageStatus leaf(const PageView& view, std::string_view low, std::string_view high, bool is_integer, const VisitNode& visit, Counts& counts) {
    ++counts.leaf;
    std::string_view before;
    for (std::size_t i = 0; i < view.count(); ++i) {
      LmdbNode node;
      std::size_t node_bytes = 0;
      view.leaf_node(i, node, node_bytes);
      if (!is_within(node.key, low, high, is_integer)) return damaged("a key outside its page's range");
      if (i > 0 && compare(before, node.key, is_integer) >= 0) return damaged("keys out of order");
      before = node.key;
      if (node.is_large) {
        const std::uint64_t count = pages_.pages_of(node.size);
        if (!take_in_file(node.first_page, count)) return damaged("a value used twice or outside the file");
        counts.overflow += count;
      }
      ++counts.entries;
      const PageStatus status = visit(node);
      if (status != PageStatus::kOk) return status;
    }
    return PageStatus::kOk;
  }

  PageStatus branch(const LmdbTree& tree, const PageView& view, int depth, std::string_view low, std::string_view high, bool is_integer,
                    const VisitNode& visit, Counts& counts) {
    ++counts.branch;
    if (view.count() < 2) return damaged("a branch with one child");
    for (std::size_t i = 0; i < view.count(); ++i) {
      std::string_view key, next;
      std::uint64_t child = 0, unused = 0;
      std::size_t node_bytes = 0;
      view.branch_node(i, key, child, node_bytes);
      if (i + 1 < view.count()) view.branch_node(i + 1, next, unused, node_bytes);
      if (i > 0 && !is_within(key, low, high, is_integer)) return damaged("a branch key outside its page's range");
      if (i > 1) {
        std::string_view before;
        view.branch_node(i - 1, before, unused, node_bytes);
        if (compare(before, key, is_integer) >= 0) return damaged("branch keys out of order");
      }
      if (is_integer && !next.empty() && next.size() != 8) return damaged("a branch key of odd size");
      const PageStatus status = page(tree, child, depth + 1, i == 0 ? low : key, next.empty() ? high : next, is_integer, visit, counts);
      if (status != PageStatus::kOk) return status;
    }
    return PageStatus::kOk;
  }

  const LmdbPages& pages_;
  const LmdbSnapshot& snapshot_;
  const std::uint64_t file_pages_;
  std::string& reason_;
  std::vector<bool> used_;
  std::vector<std::pair<std::size_t, std::size_t>> extents_;
};

PageStatus LmdbPages::check(const LmdbSnapshot& snapshot, const Visit& visit, std::string& reason) const {
  const off_t file_bytes = ::lseek(fd_, 0, SEEK_END);
  if (file_bytes < 0) return PageStatus::kReadError;
  LmdbWalk walk(*this, snapshot, static_cast<std::uint64_t>(file_bytes), reason);
  const PageStatus free_status = walk.tree(snapshot.free_tree, true, [&](const LmdbNode& node) { return walk.free_record(node); });
  if (free_status != PageStatus::kOk) return free_status;
  return walk.tree(snapshot.main_tree, false, [&](const LmdbNode& node) {
    if (node.flags != kNodeTree || node.value.size() != kTreeBytes) return walk.damaged("a record in the main tree that is no database");
    const LmdbTree named = tree_at(node.value.data());
    if (named.flags != 0) return walk.damaged("a database with unknown flags");
    return walk.tree(named, false, [&](const LmdbNode& inner) {
      if (inner.flags & kNodeTree) return walk.damaged("a database within a database");
      return visit(node.key, inner) ? PageStatus::kOk : walk.damaged("a record that is not ours");
    });
  });
}

}  // namespace lodestone
