#include "server/rollouts/traffic_metrics.h"

#include <string>
#include <utility>

#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

using prometheus::ClientMetric;
using prometheus::MetricFamily;

MetricFamily Gauge(const char* name, const char* help) {
  return {.name = name, .help = help, .type = prometheus::MetricType::Gauge, .metric = {}};
}

void Add(MetricFamily& family, std::vector<ClientMetric::Label> labels, double value) {
  ClientMetric metric;
  metric.label = std::move(labels);
  metric.gauge.value = value;
  family.metric.push_back(std::move(metric));
}

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
      Gauge("spikeserve_policy_traffic_ratio",
            "Share of the new sessions that name neither a version nor a label.");
  MetricFamily labels = Gauge("spikeserve_policy_label_info", "1 for each label of a version.");
  MetricFamily shadow =
      Gauge("spikeserve_policy_shadow_info", "1 for the version that shadows the others.");
  MetricFamily rollout =
      Gauge("spikeserve_policy_rollout_ratio",
            "Share of the new sessions that the last roll-out of a policy has reached.");
  MetricFamily ended = Gauge("spikeserve_policy_rollout_ended_timestamp_seconds",
                             "Unix time at which the last roll-out of a policy ended.");
  for (const auto& [name, policy] : catalog.policies()) {
    const PolicySettings& settings = policy.settings;
    for (const auto& [version, served] : policy.versions) {
      const int percent = settings.shares.empty() ? (version == policy.DefaultVersion() ? 100 : 0)
                                                  : settings.PercentOf(version);
      Add(traffic, Named(name, version), percent / 100.0);
    }
    for (const auto& [label, version] : settings.labels) {
      Add(labels, Named(name, version, "label", label), 1.0);
    }
    if (settings.shadow_version != 0) Add(shadow, Named(name, settings.shadow_version), 1.0);
    if (!settings.rollout.has_value()) continue;
    const Rollout& last = *settings.rollout;
    const auto of_rollout = Named(name, last.version, "state", ToString(last.state));
    Add(rollout, of_rollout, last.percent() / 100.0);
    if (!last.running()) Add(ended, of_rollout, last.ended);
  }
  return {traffic, labels, shadow, rollout, ended};
}

}  // namespace spikeserve
