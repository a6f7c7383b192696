// What the server's JSON files share: errors that name a field, what was expected and what came.
//
// Pure functions; safe to call from many threads.
#ifndef CORE_BASE_STRICT_JSON_H_
#define CORE_BASE_STRICT_JSON_H_

#include <set>
#include <string>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "nlohmann/json.hpp"

namespace spikeserve {

// INVALID_ARGUMENT: "`field`: expected `expected`, received ...".
absl::Status UnexpectedJson(absl::string_view field, absl::string_view expected,
                            const nlohmann::json& received);

// INVALID_ARGUMENT unless `object` is one whose keys are all in `keys`.
absl::Status CheckKeys(absl::string_view field, const nlohmann::json& object,
                       const std::set<std::string>& keys);

}  // namespace spikeserve

#endif  // CORE_BASE_STRICT_JSON_H_
