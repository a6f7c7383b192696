// Keeps what the server reads and writes within the policy directory: symbolic links may lead to
// other places in it, but not out of it.
//
// Thread-safe.
#pragma once

#include <filesystem>

#include "absl/status/status.h"

namespace spikeserve {

// Returns INVALID_ARGUMENT, which starts with the path, if `path`, all links followed, lies outside
// `directory`. OK if it does not exist; whoever opens it then fails. The directory itself may be a
// link.
absl::Status CheckWithin(const std::filesystem::path& directory, const std::filesystem::path& path);

}  // namespace spikeserve
