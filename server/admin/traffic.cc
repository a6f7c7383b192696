#include "server/admin/traffic.h"

namespace spikeserve {

v1::Traffic TrafficOf(const PolicyCatalog& catalog, const std::string& policy) {
  v1::Traffic traffic;
  const auto found = catalog.FindPolicy(policy);
  if (!found.ok()) return traffic;
  const PolicySettings& settings = (*found)->settings;
  for (const auto& [version, served] : (*found)->versions) traffic.add_versions(version);
  traffic.set_default_version((*found)->DefaultVersion());
  traffic.set_default_follows_highest(settings.default_version == 0);
  traffic.mutable_labels()->insert(settings.labels.begin(), settings.labels.end());
  for (const TrafficShare& share : settings.shares) {
    auto* proto = traffic.add_shares();
    proto->set_version(share.version);
    proto->set_percent(share.percent);
  }
  traffic.set_shadow_version(settings.shadow_version);
  if (settings.rollout_running()) traffic.set_rollout_version(settings.rollout->version);
  return traffic;
}

absl::Status ChangeTraffic(const PolicyRegistry& registry, const std::string& policy,
                           v1::TrafficChange* traffic, absl::FunctionRef<absl::Status()> change) {
  *traffic->mutable_before() = TrafficOf(*registry.catalog(), policy);
  auto status = change();
  *traffic->mutable_after() = TrafficOf(*registry.catalog(), policy);
  traffic->set_shared(registry.settings().is_shared());
  return status;
}

}  // namespace spikeserve
