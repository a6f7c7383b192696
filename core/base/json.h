// Parses JSON strictly and within limits: repeated keys and text around the document are errors. No
// function throws.
//
// All functions are pure and thread-safe.
#pragma once

#include <string>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "nlohmann/json.hpp"

namespace spikeserve {

// Limits on the nesting and on the number of values of one document. Valid policy files stay far
// below both.
inline constexpr int kMaxJsonDepth = 32;
inline constexpr int kMaxJsonValues = 1'000'000;

// Parses `text` as one JSON object in UTF-8, with nothing but white space around it.
// INVALID_ARGUMENT if `text` is anything else, if an object contains a key twice, or if the
// document exceeds the limits above; the message starts with `field`.
absl::StatusOr<nlohmann::json> ParseJsonObject(absl::string_view field, absl::string_view text);

// Returns `text` in double quotes for an error message: escaped to ASCII, and cut after 80 bytes.
std::string Quoted(absl::string_view text);

// Describes `value` for an error message: "an object", "an array of N", or the value itself. Cuts a
// long string as Quoted() does.
std::string Describe(const nlohmann::json& value);

}  // namespace spikeserve
