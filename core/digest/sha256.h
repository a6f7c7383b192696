// The digest of SHA-256.
//
// Pure functions; safe to call from many threads.
#pragma once

#include <array>
#include <cstdint>
#include <string>

#include "absl/strings/string_view.h"

namespace spikeserve {

// Returns the SHA-256 of bytes. Allocates and locks only in the first call of a thread.
std::array<uint8_t, 32> Sha256BytesOf(absl::string_view bytes);

// Returns the same in hexadecimal.
std::string Sha256Of(absl::string_view bytes);

}  // namespace spikeserve
