// Keeps constant bytes once in memory for all processes of a user, in a file that each of them
// maps.
//
//   auto weights = ShareBytes("/dev/shm/policies", bytes);  // equal to `bytes`, which can be freed
//
// All functions are thread-safe.
#pragma once

#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

// Returns a read-only mapping of a file in `folder` that contains exactly `bytes`, aligned to a
// page. The mapping ends with the last copy of the pointer. The first caller writes the file; later
// callers compare its content with `bytes` and replace a file that differs, so nothing in the
// folder is trusted. Creates `folder` if it is missing; the memory is that of the page cache, or of
// the file system if `folder` is on a tmpfs such as /dev/shm.
//
// Files may be deleted or replaced at any time: a mapping keeps the file that it maps. Truncating a
// mapped file ends the processes that read it with SIGBUS; the files cannot be opened for writing
// by others than root.
//
// INVALID_ARGUMENT if `folder` is no directory, belongs to another user, or can be written by other
// users, or if `bytes` is empty. The code of the system's error if a file cannot be written or
// mapped. Messages start with the path.
absl::StatusOr<std::shared_ptr<const char>> ShareBytes(const std::string& folder,
                                                       absl::string_view bytes);

}  // namespace spikeserve
