// Reads whole files, and replaces files so that readers see the old content or the new, never a
// part.
//
// Safe to call from many threads.
#ifndef CORE_BASE_FILE_H_
#define CORE_BASE_FILE_H_

#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

// Returns the content of the file at `path`. NOT_FOUND if it cannot be opened or read, as when it
// is a directory; the message starts with the path.
absl::StatusOr<std::string> ReadFile(const std::string& path);

// Writes the concatenated `pieces` to a temporary file beside `path`, flushes it to disk, renames
// it to `path` and flushes the directory. On an error, `path` keeps its old content and the
// temporary file is removed; the message starts with the path. If several threads write the same
// path, the last rename wins.
absl::Status WriteFileAtomically(const std::string& path,
                                 const std::vector<absl::string_view>& pieces);

}  // namespace spikeserve

#endif  // CORE_BASE_FILE_H_
