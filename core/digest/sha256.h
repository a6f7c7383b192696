// The digest that identifies a policy file.
//
// Pure function; safe to call from many threads.
#pragma once

#include <string>

#include "absl/strings/string_view.h"

namespace spikeserve {

// Returns the SHA-256 of bytes in hexadecimal.
std::string Sha256Of(absl::string_view bytes);

}  // namespace spikeserve
