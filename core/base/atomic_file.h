// Replacing a file so that readers see the old one or the new one, never half of it.
#ifndef CORE_BASE_ATOMIC_FILE_H_
#define CORE_BASE_ATOMIC_FILE_H_

#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

// Writes the concatenated `pieces` to a temporary file beside `path`, flushes it to disk, renames
// it to `path` and flushes the directory. On an error `path` is as it was and no temporary file
// stays behind; the message names the path. Safe to call from many threads; the last rename wins.
absl::Status WriteFileAtomically(const std::string& path,
                                 const std::vector<absl::string_view>& pieces);

}  // namespace spikeserve

#endif  // CORE_BASE_ATOMIC_FILE_H_
