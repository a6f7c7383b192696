#include "core/store/lmdb_file.h"

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cstring>
#include <optional>
#include <utility>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "core/base/status_macros.h"
#include "core/store/stored_session.h"

namespace spikeserve {
namespace {

// The layout of pages in mdb.c of LMDB 0.9, on 64-bit machines. All numbers are little-endian.
constexpr size_t kHeaderBytes = 16;  // number (8), pad (2), flags (2), lower (2), upper (2)
constexpr size_t kNodeBytes = 8;     // before the key of a node
constexpr size_t kTableBytes = 48;   // of MDB_db
constexpr size_t kMetaBytes = 24 + 2 * kTableBytes + 16;
constexpr uint16_t kBranchPage = 0x01;
constexpr uint16_t kLeafPage = 0x02;
constexpr uint16_t kOverflowPage = 0x04;
constexpr uint16_t kMetaPage = 0x08;
constexpr uint16_t kBigNode = 0x01;    // the value lies on overflow pages
constexpr uint16_t kTableNode = 0x02;  // the value describes a table
constexpr uint32_t kMagic = 0xBEEFC0DE;
constexpr uint32_t kFormat = 1;
constexpr uint64_t kNoPage = ~uint64_t{0};
constexpr size_t kMostKeyBytes = 511;
constexpr int kMostDepth = 32;

template <typename T>
T Load(absl::string_view bytes, size_t offset) {
  T value;
  std::memcpy(&value, bytes.data() + offset, sizeof(T));
  return value;
}

// MDB_db: where a table begins.
struct Table {
  uint16_t depth = 0;
  uint64_t root = kNoPage;

  static Table Parse(absl::string_view bytes) {
    return {.depth = Load<uint16_t>(bytes, 6), .root = Load<uint64_t>(bytes, 40)};
  }
};

// MDB_meta: what a transaction has left.
struct Meta {
  uint32_t page_bytes = 0;
  Table free;  // pages that may be used again
  Table main;  // of the tables with a name
  uint64_t last_page = 0;
  uint64_t transaction = 0;
};

class Scan {
 public:
  Scan(int file, LmdbVisitor visit, LmdbGapVisitor gap) : file_(file), visit_(visit), gap_(gap) {}

  absl::Status Run() {
    RETURN_IF_ERROR(ChooseMeta());
    taken_.assign(meta_.last_page + 1, false);
    const auto check_free = [this](const Node& node, absl::string_view value) {
      CheckFreePages(node, value);
    };
    WalkTable(meta_.free, {.name = "", .order = Order::kNumber, .visit = check_free});
    const auto walk_named = [this](const Node& named, absl::string_view value) {
      if (named.flags != kTableNode || value.size() != kTableBytes) {
        return Report(meta_.main.root, "expected the description of a table");
      }
      const std::string name(named.key);
      const auto visit = [&](const Node& node, absl::string_view bytes) {
        visit_(name, node.key, bytes);
      };
      WalkTable(Table::Parse(value), {.name = name, .order = Order::kBytes, .visit = visit});
    };
    WalkTable(meta_.main, {.name = "", .order = Order::kBytes, .visit = walk_named});
    return absl::OkStatus();
  }

  std::vector<LmdbDamage> TakeDamage() { return std::move(damage_); }

 private:
  // The keys of a page lie in [from, to); no `to`: no end.
  struct Bounds {
    std::string from;
    std::optional<std::string> to;
  };
  struct Node {
    uint16_t flags = 0;
    uint64_t size = 0;    // of the value, or the page of a branch's child
    size_t value_at = 0;  // in the page
    absl::string_view key;
  };
  enum class Order { kBytes, kNumber };
  using Visit = absl::FunctionRef<void(const Node& node, absl::string_view value)>;
  // A table that is walked.
  struct Walk {
    absl::string_view name;
    Order order;
    Visit visit;
  };

  std::optional<Meta> ReadMeta(uint64_t page, size_t offset) {
    const std::string bytes = ReadBytes(offset, kHeaderBytes + kMetaBytes);
    const absl::string_view meta = absl::string_view(bytes).substr(kHeaderBytes);
    const Meta parsed = {.page_bytes = Load<uint32_t>(meta, 24),
                         .free = Table::Parse(meta.substr(24)),
                         .main = Table::Parse(meta.substr(24 + kTableBytes)),
                         .last_page = Load<uint64_t>(meta, 24 + 2 * kTableBytes),
                         .transaction = Load<uint64_t>(meta, 32 + 2 * kTableBytes)};
    const bool is_meta = (Load<uint16_t>(bytes, 10) & kMetaPage) != 0 &&
                         Load<uint32_t>(meta, 0) == kMagic && Load<uint32_t>(meta, 4) == kFormat;
    const uint64_t size = parsed.page_bytes;
    const bool is_power = size >= 512 && size <= 65536 && (size & (size - 1)) == 0;
    if (is_meta && is_power && parsed.last_page < kMostStoreBytes / size) return parsed;
    Report(page, "expected a description of the file");
    return std::nullopt;
  }

  // The two descriptions are written in turn, so the newer one is that of the last transaction.
  absl::Status ChooseMeta() {
    auto first = ReadMeta(0, 0);
    const auto page_bytes =
        first.has_value() ? first->page_bytes : static_cast<uint64_t>(sysconf(_SC_PAGESIZE));
    auto second = ReadMeta(1, page_bytes);
    if (!first.has_value() && !second.has_value()) {
      return absl::DataLossError("expected a file of LMDB, received one without its first pages");
    }
    const bool is_second =
        !first.has_value() || (second.has_value() && second->transaction > first->transaction);
    meta_ = is_second ? *second : *first;
    return absl::OkStatus();
  }

  // Bytes behind the end of the file, or of a broken disk, are zeros.
  std::string ReadBytes(uint64_t offset, size_t count) const {
    std::string bytes(count, '\0');
    size_t done = 0;
    while (done < count) {
      const ssize_t received =
          pread(file_, bytes.data() + done, count - done, static_cast<off_t>(offset + done));
      if (received < 0 && errno == EINTR) continue;
      if (received <= 0) break;
      done += static_cast<size_t>(received);
    }
    return bytes;
  }

  void Report(uint64_t page, std::string reason) {
    damage_.push_back({.page = page, .reason = std::move(reason)});
  }

  // Returns false and reports `page` if it is none, or was met before.
  bool Take(uint64_t page) {
    if (page < 2 || page > meta_.last_page) {
      Report(page, absl::StrCat("expected a page from 2 to ", meta_.last_page));
      return false;
    }
    if (taken_[page]) {
      Report(page, "expected one use, received two");
      return false;
    }
    taken_[page] = true;
    return true;
  }

  void WalkTable(const Table& table, const Walk& walk) {
    if (table.root == kNoPage) return;
    if (table.depth < 1 || table.depth > kMostDepth) {
      Report(table.root,
             absl::StrCat("expected 1 to ", kMostDepth, " levels, received ", table.depth));
      return gap_(walk.name);
    }
    WalkPage(table.root, table.depth, {}, walk);
  }

  void WalkPage(uint64_t number, int levels, const Bounds& bounds, const Walk& walk) {
    if (!Take(number)) return gap_(walk.name);
    const bool is_branch = levels > 1;
    const std::string page = ReadBytes(number * meta_.page_bytes, meta_.page_bytes);
    const auto keys = CheckHeader(number, page, is_branch ? kBranchPage : kLeafPage);
    if (!keys.has_value()) return gap_(walk.name);
    return is_branch ? WalkBranch(number, page, *keys, levels, bounds, walk)
                     : WalkLeaf(number, page, *keys, bounds, walk);
  }

  // Returns the number of keys, or nullopt if the header is damaged.
  std::optional<size_t> CheckHeader(uint64_t number, absl::string_view page, uint16_t kind) {
    const auto own = Load<uint64_t>(page, 0);
    const auto flags = Load<uint16_t>(page, 10);
    const size_t lower = Load<uint16_t>(page, 12);
    const size_t upper = Load<uint16_t>(page, 14);
    if (own != number) {
      Report(number, absl::StrCat("expected its own number, received ", own));
    } else if (flags != kind) {
      Report(number, absl::StrCat("expected the kind ", kind, ", received ", flags));
    } else if (lower < kHeaderBytes + 2 || lower % 2 != 0 || lower > upper || upper > page.size()) {
      Report(number,
             absl::StrCat("expected keys and values, received them at ", lower, " and ", upper));
    } else {
      return (lower - kHeaderBytes) / 2;
    }
    return std::nullopt;
  }

  std::optional<Node> ParseNode(uint64_t number, absl::string_view page, size_t index,
                                bool is_branch) {
    const size_t at = Load<uint16_t>(page, kHeaderBytes + 2 * index);
    const size_t lowest = Load<uint16_t>(page, 14);
    if (at >= lowest && at % 2 == 0 && at + kNodeBytes <= page.size()) {
      const uint64_t low = Load<uint32_t>(page, at);
      const auto flags = Load<uint16_t>(page, at + 4);
      const size_t key_bytes = Load<uint16_t>(page, at + 6);
      Node node = {.flags = is_branch ? uint16_t{0} : flags,
                   .size = is_branch ? low | uint64_t{flags} << 32 : low,
                   .value_at = at + kNodeBytes + key_bytes,
                   .key = {}};
      const bool is_big = node.flags == kBigNode;
      const uint64_t in_page = is_branch ? 0 : is_big ? sizeof(uint64_t) : node.size;
      const bool is_known = is_branch || flags == 0 || is_big || flags == kTableNode;
      if (is_known && key_bytes <= kMostKeyBytes && node.value_at + in_page <= page.size()) {
        node.key = page.substr(at + kNodeBytes, key_bytes);
        return node;
      }
    }
    Report(number, absl::StrCat("expected key ", index, " within the page"));
    return std::nullopt;
  }

  void WalkBranch(uint64_t number, absl::string_view page, size_t keys, int levels,
                  const Bounds& bounds, const Walk& walk) {
    // The key of the first child is not used: it has everything before the second one.
    std::vector<std::optional<Node>> nodes;
    for (size_t i = 0; i < keys; ++i) {
      nodes.push_back(ParseNode(number, page, i, /*is_branch=*/true));
      if (i == 0 || !nodes[i].has_value()) continue;
      const bool in_order = i == 1 || !nodes[i - 1].has_value() ||
                            IsBefore(nodes[i - 1]->key, nodes[i]->key, walk.order);
      if (!in_order) Report(number, absl::StrCat("expected key ", i, " behind the one before"));
    }
    for (size_t i = 0; i < keys; ++i) {
      if (!nodes[i].has_value()) {
        gap_(walk.name);
        continue;
      }
      Bounds inner = bounds;
      if (i > 0) inner.from = std::string(nodes[i]->key);
      if (i + 1 < keys && nodes[i + 1].has_value()) inner.to = std::string(nodes[i + 1]->key);
      WalkPage(nodes[i]->size, levels - 1, inner, walk);
    }
  }

  void WalkLeaf(uint64_t number, absl::string_view page, size_t keys, const Bounds& bounds,
                const Walk& walk) {
    std::string last = bounds.from;
    for (size_t i = 0; i < keys; ++i) {
      const auto node = ParseNode(number, page, i, /*is_branch=*/false);
      if (!node.has_value()) {
        gap_(walk.name);
        continue;
      }
      const bool is_first = i == 0;
      const bool in_order = is_first ? last.empty() || !IsBefore(node->key, last, walk.order)
                                     : IsBefore(last, node->key, walk.order);
      const bool in_bounds = !bounds.to.has_value() || IsBefore(node->key, *bounds.to, walk.order);
      if (!in_order || !in_bounds) {
        Report(number, absl::StrCat("expected key ", i, " between its neighbours"));
        gap_(walk.name);
        continue;
      }
      last = std::string(node->key);
      if (const auto value = ReadValue(page, *node); value.has_value()) {
        walk.visit(*node, *value);
      } else {
        gap_(walk.name);
      }
    }
  }

  // Returns the value of a node of a leaf, or nullopt if its overflow pages are damaged.
  std::optional<std::string> ReadValue(absl::string_view page, const Node& node) {
    if (node.flags != kBigNode) return std::string(page.substr(node.value_at, node.size));
    const auto first = Load<uint64_t>(page, node.value_at);
    const uint64_t least = (kHeaderBytes - 1 + node.size) / meta_.page_bytes + 1;
    if (!Take(first)) return std::nullopt;
    const std::string header = ReadBytes(first * meta_.page_bytes, kHeaderBytes);
    const uint64_t pages = Load<uint32_t>(header, 12);
    const bool is_whole = Load<uint64_t>(header, 0) == first &&
                          Load<uint16_t>(header, 10) == kOverflowPage && pages >= least &&
                          first + pages - 1 <= meta_.last_page;
    if (!is_whole) {
      Report(first, absl::StrCat("expected the first of at least ", least, " pages with a value"));
      return std::nullopt;
    }
    for (uint64_t other = first + 1; other < first + pages; ++other) {
      if (!Take(other)) return std::nullopt;
    }
    return ReadBytes(first * meta_.page_bytes + kHeaderBytes, node.size);
  }

  // A value is the number of pages and then their numbers, in descending order.
  void CheckFreePages(const Node& node, absl::string_view value) {
    const size_t count = value.size() / sizeof(uint64_t);
    const bool has_count =
        node.key.size() == sizeof(uint64_t) && count >= 1 && Load<uint64_t>(value, 0) < count;
    if (!has_count) return Report(meta_.free.root, "expected a list of free pages");
    for (uint64_t i = 1; i <= Load<uint64_t>(value, 0); ++i) {
      if (!Take(Load<uint64_t>(value, i * sizeof(uint64_t)))) return;
    }
  }

  static bool IsBefore(absl::string_view a, absl::string_view b, Order order) {
    if (order == Order::kBytes) return a < b;
    const auto number = [](absl::string_view key) {
      return key.size() == sizeof(uint64_t) ? Load<uint64_t>(key, 0) : 0;
    };
    return number(a) < number(b);
  }

  const int file_;
  const LmdbVisitor visit_;
  const LmdbGapVisitor gap_;
  Meta meta_;
  std::vector<bool> taken_;  // by page
  std::vector<LmdbDamage> damage_;
};

// Closes a file.
class OpenFile {
 public:
  explicit OpenFile(const std::string& path) : number_(open(path.c_str(), O_RDONLY | O_CLOEXEC)) {}
  ~OpenFile() {
    if (number_ >= 0) close(number_);
  }
  OpenFile(const OpenFile&) = delete;
  OpenFile& operator=(const OpenFile&) = delete;
  int number() const { return number_; }

 private:
  const int number_;
};

}  // namespace

std::string Describe(const std::vector<LmdbDamage>& damage) {
  constexpr size_t kShown = 3;
  std::vector<std::string> parts;
  for (size_t i = 0; i < std::min(damage.size(), kShown); ++i) {
    parts.push_back(absl::StrCat("page ", damage[i].page, ": ", damage[i].reason));
  }
  if (damage.size() > kShown) parts.push_back(absl::StrCat(damage.size() - kShown, " more"));
  return absl::StrJoin(parts, "; ");
}

absl::StatusOr<std::vector<LmdbDamage>> ScanLmdbFile(const std::string& path, LmdbVisitor visit,
                                                     LmdbGapVisitor gap) {
  const OpenFile file(path);
  if (file.number() < 0) {
    return absl::UnavailableError(absl::StrCat(path, ": ", std::strerror(errno)));
  }
  Scan scan(file.number(), visit, gap);
  if (auto status = scan.Run(); !status.ok()) {
    return absl::Status(status.code(), absl::StrCat(path, ": ", status.message()));
  }
  return scan.TakeDamage();
}

}  // namespace spikeserve
