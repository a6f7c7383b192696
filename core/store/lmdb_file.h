// Reads the file of an LMDB environment page by page, and checks everything on which LMDB relies.
//
// LMDB maps the file and believes what it finds: at a damaged page it ends the process, reads
// behind the end of its memory, or writes over live pages. This reader believes nothing.
//
//   const auto damage = ScanLmdbFile(path, [](absl::string_view table, ...) { ... }, gap);
//   if (damage.ok() && damage->empty()) ... LMDB may open the file
//
// It knows named tables without duplicates, of LMDB 0.9. Free functions without shared state; safe
// to call from many threads.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "absl/functional/function_ref.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

// A page that cannot be used, and why.
struct LmdbDamage {
  uint64_t page = 0;
  std::string reason;
};

// Returns e.g. "page 7: expected its own number, received 1234; page 9: ...", of the first ones.
std::string Describe(const std::vector<LmdbDamage>& damage);

using LmdbVisitor = absl::FunctionRef<void(absl::string_view table, absl::string_view key,
                                           absl::string_view value)>;
// Called where keys of a table cannot be read, between the calls for those before and after them.
using LmdbGapVisitor = absl::FunctionRef<void(absl::string_view table)>;

// Calls `visit` for all keys that can be read, table by table, in ascending order, and returns what
// is damaged. A process that writes to the file meanwhile makes sound pages look damaged. Returns
// UNAVAILABLE if the file cannot be read, and DATA_LOSS if it is no file of LMDB any more.
absl::StatusOr<std::vector<LmdbDamage>> ScanLmdbFile(const std::string& path, LmdbVisitor visit,
                                                     LmdbGapVisitor gap);

}  // namespace spikeserve
