// JSON as policy files hold it: strict, bounded, and without exceptions.
//
// Free functions without shared state; safe to call from many threads.
#ifndef CORE_BASE_JSON_H_
#define CORE_BASE_JSON_H_

#include <string>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "nlohmann/json.hpp"

namespace spikeserve {

// What a document may ask for; legitimate policy files stay far below.
inline constexpr int kMaxJsonDepth = 32;
inline constexpr int kMaxJsonValues = 1'000'000;

// Parses `text`, one JSON object in UTF-8 with nothing but white space around it. INVALID_ARGUMENT
// on anything else, on a key that appears twice in an object, and beyond the limits above; the
// message starts with `field`.
absl::StatusOr<nlohmann::json> ParseJsonObject(absl::string_view field, absl::string_view text);

// `text` in quotes for an error message: escaped to ASCII, and cut where it is long.
std::string Quoted(absl::string_view text);

// What `value` is, for an error message: "an object", or the value itself where it is short.
std::string Describe(const nlohmann::json& value);

}  // namespace spikeserve

#endif  // CORE_BASE_JSON_H_
