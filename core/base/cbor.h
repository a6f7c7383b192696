// Parses CBOR (RFC 8949) from files, stores and unauthenticated clients, within limits. No function
// throws.
//
// All functions are pure and thread-safe.
#pragma once

#include <optional>

#include "absl/strings/string_view.h"
#include "nlohmann/json.hpp"

namespace spikeserve {

// Largest nesting of arrays and maps. Everything that this project writes stays far below it.
inline constexpr int kMaxCborDepth = 32;

// Parses `bytes` as one CBOR value with nothing after it. Returns nullopt if `bytes` is anything
// else, if it is nested deeper than kMaxCborDepth, or if a text is not UTF-8, which could not be
// written as JSON.
//
// To be used instead of nlohmann::json::from_cbor, which recurses into any depth and throws for an
// array whose stated length exceeds the address space, even if exceptions are turned off.
std::optional<nlohmann::json> ParseCbor(absl::string_view bytes);

}  // namespace spikeserve
