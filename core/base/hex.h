// Reads bytes from hexadecimal text. A free function, safe to call from many threads.
#pragma once

#include <optional>
#include <string>

#include "absl/strings/string_view.h"

namespace spikeserve {

// Returns the bytes that pairs of hexadecimal digits, in upper or lower case, stand for; nullopt if
// `text` has anything else. Abseil's HexStringToBytes has changed its signature.
std::optional<std::string> ParseHex(absl::string_view text);

}  // namespace spikeserve
