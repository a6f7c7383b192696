#include "server/gauges.h"

#include <array>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/learning/fleet_head.h"
#include "prometheus/client_metric.h"

namespace spikeserve {
namespace {

using prometheus::ClientMetric;
using prometheus::MetricFamily;

MetricFamily GaugeFamily(const char* name, const char* help) {
  return {.name = name, .help = help, .type = prometheus::MetricType::Gauge, .metric = {}};
}

MetricFamily CounterFamily(const char* name, const char* help) {
  return {.name = name, .help = help, .type = prometheus::MetricType::Counter, .metric = {}};
}

void AddGauge(MetricFamily& family, std::vector<ClientMetric::Label> labels, double value) {
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

MetricFamily ByLimit(const char* name, const char* help,
                     const ConnectionTable::CountByLimit& counts) {
  MetricFamily family = CounterFamily(name, help);
  for (size_t i = 0; i < counts.size(); ++i) {
    ClientMetric metric;
    metric.label = {{"limit", std::string(ToString(static_cast<ConnectionLimit>(i)))}};
    metric.counter.value = static_cast<double>(counts[i]);
    family.metric.push_back(std::move(metric));
  }
  return family;
}

}  // namespace

std::vector<MetricFamily> CollectRobots(SessionStore& store) {
  int64_t robots = 0;
  int64_t silent = 0;
  store.ForEach([](const SessionEntry& entry) { return entry.period > absl::ZeroDuration(); },
                [&](const ListedSession& listed) {
                  ++robots;
                  silent += IsSilent(listed.entry->period, listed.idle) ? 1 : 0;
                });
  std::vector<MetricFamily> families = {
      GaugeFamily("spikeserve_robots", "Open sessions whose robot has declared its period."),
      GaugeFamily(
          "spikeserve_silent_robots",
          "Those of spikeserve_robots that have sent nothing for longer than 50 periods and "
          "2 seconds.")};
  AddGauge(families[0], {}, static_cast<double>(robots));
  AddGauge(families[1], {}, static_cast<double>(silent));
  return families;
}

std::vector<MetricFamily> CollectSeats(SessionStore& store) {
  int64_t seats = 0;
  const auto was_taken = [](const SessionEntry& entry) {
    return entry.was_taken.load(std::memory_order_relaxed);
  };
  store.ForEach(was_taken, [&](const ListedSession& listed) {
    absl::MutexLock lock(&listed.entry->mutex);
    seats += listed.entry->agent.seat() != nullptr ? 1 : 0;
  });
  auto family = GaugeFamily("spikeserve_seats",
                            "Open sessions in which an operator acts in the policy's place.");
  AddGauge(family, {}, static_cast<double>(seats));
  return {std::move(family)};
}

std::vector<MetricFamily> CollectCertificates(const CertificateWatch& certificates) {
  auto failing = GaugeFamily("spikeserve_tls_reload_failing",
                             "1 while changed files of TLS cannot be used; the old ones are.");
  AddGauge(failing, {}, certificates.fails() ? 1.0 : 0.0);
  auto expiry = GaugeFamily("spikeserve_tls_expiry_timestamp_seconds",
                            "Unix time at which a certificate expires: server, with its chain, or "
                            "client_ca.");
  if (certificates.is_used()) {
    const CertificateTimes times = certificates.times();
    AddGauge(expiry, {{"certificate", "server"}},
             absl::ToDoubleSeconds(times.end - absl::UnixEpoch()));
    if (times.client_ca != absl::InfiniteFuture()) {
      AddGauge(expiry, {{"certificate", "client_ca"}},
               absl::ToDoubleSeconds(times.client_ca - absl::UnixEpoch()));
    }
  }
  return {std::move(failing), std::move(expiry)};
}

std::vector<MetricFamily> CollectDatagrams(const DatagramChannels& datagrams) {
  constexpr std::array<const char*, kDatagramOutcomes> kNames = {
      "taken", "malformed", "unknown_key", "replayed", "forged", "refused"};
  MetricFamily family = CounterFamily(
      "spikeserve_datagrams_total",
      "Datagrams that have arrived, by what became of them: taken (a step is answered), or dropped "
      "without an answer, because they are malformed, name an unknown key, are replayed or forged, "
      "or their sender has to wait (refused).");
  for (size_t i = 0; i < kDatagramOutcomes; ++i) {
    ClientMetric metric;
    metric.label = {{"outcome", kNames[i]}};
    metric.counter.value = static_cast<double>(datagrams.count(static_cast<DatagramOutcome>(i)));
    family.metric.push_back(std::move(metric));
  }
  return {std::move(family)};
}

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
      AddGauge(held_out, Named(name, version), static_cast<double>(sessions));
      AddGauge(trimmed, Named(name, version), static_cast<double>(contributions));
    }
  }
  return {std::move(held_out), std::move(trimmed)};
}

std::vector<MetricFamily> CollectHeadLogs(HeadLogStore& logs) {
  MetricFamily positions = GaugeFamily(
      "spikeserve_head_log_position",
      "Number of the last entry of the log of a shared head that this server has taken.");
  for (const auto& [version, position] : logs.Positions()) {
    AddGauge(positions, Named(version.first, version.second), static_cast<double>(position));
  }
  return {std::move(positions)};
}

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

std::vector<MetricFamily> CollectConnections(const Transport& transport) {
  const ConnectionTable::Counts counts = transport.connections().counts();
  MetricFamily open =
      GaugeFamily("spikeserve_connections",
                  "Open connections of gRPC. Unauthenticated: none of its calls was admitted yet.");
  AddGauge(open, {{"state", "known"}}, static_cast<double>(counts.open - counts.unauthenticated));
  AddGauge(open, {{"state", "unauthenticated"}}, static_cast<double>(counts.unauthenticated));
  MetricFamily limit =
      GaugeFamily("spikeserve_connections_limit", "Limit on the open connections of gRPC.");
  AddGauge(limit, {}, static_cast<double>(transport.connections().max_connections()));
  MetricFamily bytes = GaugeFamily(
      "spikeserve_bytes_in_flight",
      "Memory of requests and answers in flight: of the calls of all callers, and of the "
      "unauthenticated connections and calls.");
  AddGauge(bytes, {{"of", "all"}}, static_cast<double>(transport.budgets().all.used()));
  AddGauge(bytes, {{"of", "unauthenticated"}},
           static_cast<double>(transport.budgets().unauthenticated.used()));
  return {std::move(open), std::move(limit), std::move(bytes),
          ByLimit("spikeserve_connections_refused_total",
                  "New connections that were refused, by the limit that they met.", counts.refused),
          ByLimit("spikeserve_connections_dropped_total",
                  "Unauthenticated connections that were closed to make room for others, by limit.",
                  counts.dropped)};
}

}  // namespace spikeserve
