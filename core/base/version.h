// Provides the version of all programs and packages, which is set by project() in the root
// CMakeLists.txt.
#pragma once

#include "absl/strings/string_view.h"

namespace spikeserve {

// Returns "MAJOR.MINOR.PATCH", for example "0.2.0".
absl::string_view Version();

}  // namespace spikeserve
