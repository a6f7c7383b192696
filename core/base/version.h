// Provides the version of all programs and packages, which is set by project() in the root
// CMakeLists.txt.
#ifndef CORE_BASE_VERSION_H_
#define CORE_BASE_VERSION_H_

#include "absl/strings/string_view.h"

namespace spikeserve {

// Returns "MAJOR.MINOR.PATCH", for example "0.2.0".
absl::string_view Version();

}  // namespace spikeserve

#endif  // CORE_BASE_VERSION_H_
