#include "server/rollouts/traffic_metrics.h"

#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "server/metrics/gauge_family.h"

namespace spikeserve {
namespace {

using prometheus::ClientMetric;
using prometheus::MetricFamily;

std::vector<ClientMetric::Label> Named(const std::string& policy, int64_t version) {
  return {{"policy", policy}, {"version", absl::StrCat(version)}};
}

std::vector<ClientMetric::Label> Named(const std::string& policy, int64_t version,
                                       const char* label, absl::string_view value) {
  auto labels = Named(policy, version);
  labels.push_back({label, std::string(value)});
  return labels;
}

}  // namespace

std::vector<MetricFamily> CollectTraffic(const PolicyCatalog& catalog) {
  MetricFamily traffic =
      GaugeFamily("spikeserve_policy_traffic_ratio",
                  "Share of the new sessions that name neither a version nor a label.");
  MetricFamily labels =
      GaugeFamily("spikeserve_policy_label_info", "1 for each label of a version.");
  MetricFamily shadow =
      GaugeFamily("spikeserve_policy_shadow_info", "1 for the version that shadows the others.");
  MetricFamily rollout =
      GaugeFamily("spikeserve_policy_rollout_ratio",
                  "Share of the new sessions that the last roll-out of a policy has reached.");
  MetricFamily disputed =
      GaugeFamily("spikeserve_policy_rollout_disputed",
                  "1 while a roll-out waits, because the sessions of one tenant decide whether the "
                  "version is worse; otherwise 0.");
  MetricFamily ended = GaugeFamily("spikeserve_policy_rollout_ended_timestamp_seconds",
                                   "Unix time at which the last roll-out of a policy ended.");
  for (const auto& [name, policy] : catalog.policies()) {
    const PolicySettings& settings = policy.settings;
    for (const auto& [version, served] : policy.versions) {
      const int percent = settings.shares.empty() ? (version == policy.DefaultVersion() ? 100 : 0)
                                                  : settings.PercentOf(version);
      AddGauge(traffic, Named(name, version), percent / 100.0);
    }
    for (const auto& [label, version] : settings.labels) {
      AddGauge(labels, Named(name, version, "label", label), 1.0);
    }
    if (settings.shadow_version != 0) AddGauge(shadow, Named(name, settings.shadow_version), 1.0);
    if (!settings.rollout.has_value()) continue;
    const Rollout& last = *settings.rollout;
    const auto of_rollout = Named(name, last.version, "state", ToString(last.state));
    AddGauge(rollout, of_rollout, last.percent() / 100.0);
    AddGauge(disputed, Named(name, last.version), last.disputed.empty() ? 0.0 : 1.0);
    if (!last.running()) AddGauge(ended, of_rollout, last.ended);
  }
  return {traffic, labels, shadow, rollout, disputed, ended};
}

}  // namespace spikeserve
