// Reads and replaces whole files. Replacement is atomic: a reader sees either the old content or
// the new content, never a part of it.
//
// All functions are thread-safe.
#pragma once

#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

// Returns the content of the file at `path`. NOT_FOUND if it cannot be opened or read, for example
// because it is a directory; the message starts with the path.
absl::StatusOr<std::string> ReadFile(const std::string& path);

// Replaces the file at `path` with the concatenation of `pieces`: writes a temporary file in the
// same directory, flushes it to disk, renames it to `path` and flushes the directory. If an error
// occurs before the rename, `path` keeps its old content and the temporary file is removed. Error
// messages start with the path. If several threads write the same path, the last rename wins.
absl::Status WriteFileAtomically(const std::string& path,
                                 const std::vector<absl::string_view>& pieces);

}  // namespace spikeserve
