#include "server/admin/head_metrics.h"

#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/learning/fleet_head.h"
#include "server/metrics/gauge_family.h"

namespace spikeserve {
namespace {

using prometheus::ClientMetric;
using prometheus::MetricFamily;

// Returns all shared heads of a version.
std::vector<std::shared_ptr<FleetHead>> HeadsOf(const ServedPolicy& served) {
  std::vector<std::shared_ptr<FleetHead>> heads = {served.fleet};
  if (served.tenant_heads == nullptr) return heads;
  for (const std::string& tenant : served.tenant_heads->Tenants()) {
    auto head = served.tenant_heads->Find(tenant);
    if (head != nullptr && head != served.fleet) heads.push_back(std::move(head));
  }
  return heads;
}

}  // namespace

std::vector<MetricFamily> CollectHeads(const PolicyCatalog& catalog) {
  MetricFamily held_out = GaugeFamily(
      "spikeserve_head_held_out_sessions",
      "Open sessions of this server that contribute nothing to their shared head, because "
      "their returns judge it.");
  MetricFamily trimmed = GaugeFamily(
      "spikeserve_head_trimmed_contributions",
      "Contributions that the shared heads have shortened, because they were much longer "
      "than those of other contributors. Equal on all servers that share the heads.");
  for (const auto& [name, policy] : catalog.policies()) {
    for (const auto& [version, served] : policy.versions) {
      int64_t sessions = 0, contributions = 0;
      for (const auto& head : HeadsOf(*served)) {
        sessions += head->HeldOutSessions();
        contributions += head->Read()->trimmed;
      }
      const std::vector<ClientMetric::Label> labels = {{"policy", served->name},
                                                       {"version", absl::StrCat(served->version)}};
      AddGauge(held_out, labels, static_cast<double>(sessions));
      AddGauge(trimmed, labels, static_cast<double>(contributions));
    }
  }
  return {std::move(held_out), std::move(trimmed)};
}

}  // namespace spikeserve
