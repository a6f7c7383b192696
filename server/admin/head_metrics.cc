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
      for (const std::string& tenant : served->heads->Tenants()) {
        if (served->HeadName(tenant) != tenant) continue;  // of a time when heads were not shared
        const auto head = served->heads->Of(tenant);
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
