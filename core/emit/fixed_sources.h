// The C that is the same for every policy, compiled into the program; see cmake/EmbedFiles.cmake.
//
// Thread-safe.
#pragma once

#include <map>

#include "absl/strings/string_view.h"

namespace spikeserve {

// Returns the contents of the files of core/emit/c by their names, such as "network.c".
const std::map<absl::string_view, absl::string_view>& FixedSources();

}  // namespace spikeserve
