#include "server/policies/policy_catalog.h"

#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "core/base/json.h"
#include "core/base/names.h"
#include "core/base/status_macros.h"
#include "core/math/counter_random.h"

namespace spikeserve {
namespace {

template <typename Map>
std::vector<std::string> Keys(const Map& map) {
  std::vector<std::string> keys;
  for (const auto& item : map) keys.push_back(absl::StrCat(item.first));
  return keys;
}

// FNV-1a (Fowler, Noll & Vo). Gives a key the same hash on every replica and after a restart, which
// std::hash does not promise.
uint64_t HashOfText(absl::string_view text) {
  uint64_t hash = 0xcbf29ce484222325ull;
  for (const char c : text) hash = (hash ^ static_cast<unsigned char>(c)) * 0x100000001b3ull;
  return hash;
}

// Returns the version whose share the routing key falls into. The hash includes the policy's name,
// so that one key falls into independent shares of different policies.
int64_t ShareOf(const std::vector<TrafficShare>& shares, const VersionChoice& choice) {
  const uint64_t bits = RandomBits({HashOfText(choice.policy), HashOfText(choice.routing_key)});
  auto place = static_cast<int>(bits % 100);
  for (const TrafficShare& share : shares) {
    if (place < share.percent) return share.version;
    place -= share.percent;
  }
  return shares.back().version;  // not reached: the percents add up to 100
}

}  // namespace

int64_t CatalogPolicy::DefaultVersion() const {
  return settings.default_version != 0 ? settings.default_version : versions.rbegin()->first;
}

absl::Status CatalogPolicy::CheckVersion(const PolicyVersion& version) const {
  if (versions.contains(version.version)) return absl::OkStatus();
  return absl::NotFoundError(absl::StrCat("version: expected a served version of policy ",
                                          version.policy, ", received ", version.version));
}

absl::Status CatalogPolicy::CheckShadow(const std::string& name, std::vector<TrafficShare> shadowed,
                                        int64_t shadow_version) const {
  if (shadow_version == 0) return absl::OkStatus();
  RETURN_IF_ERROR(CheckVersion({name, shadow_version}));
  if (shadowed.empty()) shadowed = {{.version = DefaultVersion(), .percent = 100}};
  for (const TrafficShare& share : shadowed) {
    if (SameSpaces(*versions.at(share.version), *versions.at(shadow_version))) continue;
    return absl::FailedPreconditionError(
        absl::StrCat("shadow_version: expected the observations and actions of version ",
                     share.version, ", received version ", shadow_version));
  }
  return absl::OkStatus();
}

absl::Status CatalogPolicy::CheckTraffic(const std::string& name,
                                         const std::vector<TrafficShare>& shares,
                                         int64_t shadow_version) const {
  RETURN_IF_ERROR(CheckShares(shares));
  for (const TrafficShare& share : shares) {
    RETURN_IF_ERROR(CheckVersion({name, share.version}));
  }
  return CheckShadow(name, shares, shadow_version);
}

absl::StatusOr<const CatalogPolicy*> PolicyCatalog::FindPolicy(const std::string& name) const {
  const auto policy = policies_.find(name);
  if (policy != policies_.end()) return &policy->second;
  const std::vector<std::string> known = Keys(policies_);
  return absl::NotFoundError(absl::StrCat("policy: expected one of [", NamesLike(name, known),
                                          "], received ", Quoted(name), DidYouMean(name, known)));
}

absl::StatusOr<std::shared_ptr<const ServedPolicy>> PolicyCatalog::Find(const std::string& name,
                                                                        int64_t version) const {
  ASSIGN_OR_RETURN(const auto policy, FindPolicy(name));
  const auto& versions = policy->versions;
  const auto found = versions.find(version == 0 ? policy->DefaultVersion() : version);
  if (found != versions.end()) return found->second;
  return absl::NotFoundError(absl::StrCat("version: expected 0 or one of [",
                                          NamesLike(absl::StrCat(version), Keys(versions)),
                                          "] of policy ", name, ", received ", version));
}

absl::StatusOr<ChosenVersions> PolicyCatalog::Choose(const VersionChoice& choice) const {
  ASSIGN_OR_RETURN(const auto found, FindPolicy(choice.policy));
  const CatalogPolicy& policy = *found;
  int64_t version = choice.version;
  const bool is_free = version == 0 && choice.label.empty();
  if (!choice.label.empty()) {
    if (version != 0) {
      return absl::InvalidArgumentError(absl::StrCat("version_label: expected none beside version ",
                                                     version, ", received ", Quoted(choice.label)));
    }
    const auto label = policy.settings.labels.find(choice.label);
    if (label == policy.settings.labels.end()) {
      const std::vector<std::string> known = Keys(policy.settings.labels);
      return absl::NotFoundError(absl::StrCat(
          "version_label: expected one of [", NamesLike(choice.label, known), "] of policy ",
          choice.policy, ", received ", Quoted(choice.label), DidYouMean(choice.label, known)));
    }
    version = label->second;
  } else if (is_free && !policy.settings.shares.empty()) {
    version = ShareOf(policy.settings.shares, choice);
  }
  ASSIGN_OR_RETURN(auto served, Find(choice.policy, version));
  ChosenVersions route = {.served = std::move(served),
                          .shadow = nullptr,
                          .by_rollout = is_free && policy.settings.rollout_running()};
  if (policy.settings.shadow_version != 0 &&
      policy.settings.shadow_version != route.served->version) {
    const auto& shadow = policy.versions.at(policy.settings.shadow_version);
    if (SameSpaces(*shadow, *route.served)) route.shadow = shadow;
  }
  return route;
}

void PolicyCatalog::Remove(const PolicyVersion& version) {
  const auto policy = policies_.find(version.policy);
  if (policy == policies_.end()) return;
  policy->second.versions.erase(version.version);
  if (policy->second.versions.empty()) policies_.erase(policy);
}

bool SameSpaces(const ServedPolicy& a, const ServedPolicy& b) {
  return a.policy().observation_size() == b.policy().observation_size() &&
         a.policy().action_space == b.policy().action_space;
}

}  // namespace spikeserve
