#include "server/admin/head_metrics.h"

#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/learning/fleet_head.h"

namespace spikeserve {
namespace {

using prometheus::ClientMetric;
using prometheus::MetricFamily;

MetricFamily Gauge(const char* name, const char* help) {
  return {.name = name, .help = help, .type = prometheus::MetricType::Gauge, .metric = {}};
}

void Add(MetricFamily& family, const ServedPolicy& served, int64_t value) {
  ClientMetric metric;
  metric.label = {{"policy", served.name}, {"version", absl::StrCat(served.version)}};
  metric.gauge.value = static_cast<double>(value);
  family.metric.push_back(std::move(metric));
}

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
  MetricFamily held_out =
      Gauge("spikeserve_head_held_out_sessions",
            "Open sessions of this server that contribute nothing to their shared head, because "
            "their returns judge it.");
  MetricFamily trimmed =
      Gauge("spikeserve_head_trimmed_contributions",
            "Contributions that the shared heads have shortened, because they were much longer "
            "than those of other contributors. Equal on all servers that share the heads.");
  for (const auto& [name, policy] : catalog.policies()) {
    for (const auto& [version, served] : policy.versions) {
      int64_t sessions = 0, contributions = 0;
      for (const auto& head : HeadsOf(*served)) {
        sessions += head->HeldOutSessions();
        contributions += head->Read()->trimmed;
      }
      Add(held_out, *served, sessions);
      Add(trimmed, *served, contributions);
    }
  }
  return {std::move(held_out), std::move(trimmed)};
}

}  // namespace spikeserve
