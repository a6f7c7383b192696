#include "server/wiring_rules.h"

#include <utility>
#include <vector>

#include "absl/strings/str_split.h"
#include "absl/strings/string_view.h"
#include "core/base/status_macros.h"

namespace spikeserve {

absl::StatusOr<WiringRules> ParseWiringRules(const std::string& text) {
  WiringRules rules = {{"", WiringResponse::kCount}};
  for (const absl::string_view part : absl::StrSplit(text, ',', absl::SkipEmpty())) {
    const size_t equals = part.find('=');
    const bool is_of_policy = equals != absl::string_view::npos;
    ASSIGN_OR_RETURN(
        const auto response,
        ParseEnum<WiringResponse>("--wiring", is_of_policy ? part.substr(equals + 1) : part));
    rules[std::string(is_of_policy ? part.substr(0, equals) : "")] = response;
  }
  return rules;
}

}  // namespace spikeserve
