#include "core/base/strict_json.h"

#include "absl/strings/str_cat.h"
#include "core/base/json.h"

namespace spikeserve {

absl::Status UnexpectedJson(absl::string_view field, absl::string_view expected,
                            const nlohmann::json& received) {
  return absl::InvalidArgumentError(
      absl::StrCat(field, ": expected ", expected, ", received ", Describe(received)));
}

absl::Status CheckKeys(absl::string_view field, const nlohmann::json& object,
                       const std::set<std::string>& keys) {
  if (!object.is_object()) return UnexpectedJson(field, "an object", object);
  for (const auto& item : object.items()) {
    if (keys.contains(item.key())) continue;
    return absl::InvalidArgumentError(
        absl::StrCat(field, ": expected no key ", Quoted(item.key()), ", received one"));
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
