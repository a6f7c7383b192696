// The version of every program and package, as CMake's project() states it.
#ifndef CORE_BASE_VERSION_H_
#define CORE_BASE_VERSION_H_

#include "absl/strings/string_view.h"

namespace spikeserve {

// Returns MAJOR.MINOR.PATCH, such as "0.1.0".
absl::string_view Version();

}  // namespace spikeserve

#endif  // CORE_BASE_VERSION_H_
