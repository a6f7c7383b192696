// Reads a dataset in a child process of its own, for libraries that cannot be trusted with the
// bytes of untrusted files.
#pragma once

#include "absl/functional/function_ref.h"
#include "absl/status/statusor.h"
#include "core/dataset/dataset.h"

namespace spikeserve {

// Calls `read` in a child process and returns its result. The child may take ten minutes of
// processor time and half of the machine's memory. INVALID_ARGUMENT if it ends before `read`
// returns, RESOURCE_EXHAUSTED if it cannot be started.
//
// The child has only the calling thread: `read` must not need a lock that another thread may hold.
absl::StatusOr<Dataset> ReadInChild(absl::FunctionRef<absl::StatusOr<Dataset>()> read);

}  // namespace spikeserve
