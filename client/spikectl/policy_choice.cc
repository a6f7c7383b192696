#include "client/spikectl/policy_choice.h"

#include <algorithm>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/base/names.h"

namespace spikeserve {
namespace {

// Returns what the server has instead of a policy or environment, in a few lines at most.
std::string OthersThan(const std::string& received, const v1::ListPoliciesResponse& served) {
  if (served.policies().empty()) return "no policy";
  std::vector<std::string> versions;
  std::vector<std::string> names;
  for (const v1::PolicyInfo& policy : served.policies()) {
    versions.push_back(
        absl::StrCat(policy.name(), "/", policy.version(), " for ", policy.environment()));
    names.insert(names.end(), {policy.name(), policy.environment()});
  }
  return absl::StrCat(NamesLike(received, versions), DidYouMean(received, names));
}

bool SameSpace(const v1::ActionSpace& served, const ActionSpace& space) {
  if (space.is_discrete()) return served.has_discrete() && served.discrete().n() == space.n;
  const v1::Box& box = served.box();
  return served.has_box() &&
         std::equal(box.low().begin(), box.low().end(), space.low.begin(), space.low.end()) &&
         std::equal(box.high().begin(), box.high().end(), space.high.begin(), space.high.end());
}

}  // namespace

absl::StatusOr<v1::PolicyInfo> ChoosePolicy(const v1::ListPoliciesResponse& served,
                                            const std::string& environment, const std::string& name,
                                            int64_t version) {
  for (const v1::PolicyInfo& policy : served.policies()) {
    const bool wanted = name.empty() ? policy.environment() == environment : policy.name() == name;
    const bool wanted_version = version == 0 ? policy.is_default() : policy.version() == version;
    if (wanted && wanted_version) return policy;
  }
  const std::string what = name.empty() ? absl::StrCat("--env: no policy for ", environment)
                                        : absl::StrCat("--policy: no policy \"", name, "\"");
  const std::string which = version == 0 ? "" : absl::StrCat(" in version ", version);
  return absl::NotFoundError(absl::StrCat(what, which, " is served; the server has ",
                                          OthersThan(name.empty() ? environment : name, served)));
}

absl::Status CheckSpacesMatch(const v1::PolicyInfo& policy, const Environment& environment) {
  const std::string id(environment.id());
  if (policy.observation_size() != environment.observation_size()) {
    return absl::InvalidArgumentError(absl::StrCat(
        "--policy: \"", policy.name(), "\" takes observations of length ",
        policy.observation_size(), ", those of ", id, " have ", environment.observation_size()));
  }
  if (!SameSpace(policy.action_space(), environment.action_space())) {
    return absl::InvalidArgumentError(
        absl::StrCat("--policy: the action space of \"", policy.name(), "\" is not that of ", id));
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
