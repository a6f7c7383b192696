// Checks a file store before LMDB opens it, and replaces one that is damaged by what can be read of
// it.
#pragma once

#include <cstdint>
#include <optional>
#include <string>

#include "absl/status/statusor.h"

namespace spikeserve {

// What a repair has found and done.
struct FileRepair {
  std::string damage;      // for people
  std::string kept_as;     // path of the damaged file
  int64_t sessions = 0;    // that were read
  int64_t incomplete = 0;  // of them: records may be missing, so the client sends them again
  int64_t without = 0;     // of them: no record was read; a request answers DATA_LOSS
  int64_t unnamed = 0;     // journals of no known session, which were left out
};

// Returns nullopt if the store in `directory` is sound, or there is none. A damaged file is kept
// beside the new one. Returns DATA_LOSS if nothing can be read of it, and UNAVAILABLE if the new
// file cannot be written; then nothing changes. REQUIRES: no other process writes to the store.
absl::StatusOr<std::optional<FileRepair>> RepairFileStore(const std::string& directory);

}  // namespace spikeserve
