#include "server/history/alerts.h"

#include <cmath>
#include <initializer_list>
#include <string>
#include <utility>

#include "server/history/figures.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;
using Instances = std::vector<AlertInstance>;

// Episodes in half an hour below which a return is not judged, and decisions of a shadow.
constexpr double kFewestEpisodes = 10.0;
constexpr double kFewestShadowDecisions = 100.0;

TimeSpan WindowOf(const AlertRule& rule, const AlertInput& input) {
  return {.from = input.now - rule.window, .to = input.now};
}

// Returns the series by the values of the given labels.
std::map<MetricLabels, Selection> GroupBy(std::initializer_list<const char*> labels,
                                          const Selection& all) {
  std::map<MetricLabels, Selection> groups;
  for (const MetricSeries* series : all) {
    MetricLabels key;
    for (const char* label : labels) {
      const auto found = series->labels.find(label);
      if (found != series->labels.end()) key.insert(*found);
    }
    groups[key].push_back(series);
  }
  return groups;
}

Instances ServerIf(bool holds, double value) {
  return holds ? Instances{{.labels = {}, .value = value}} : Instances{};
}

Instances ShareOfCalls(const AlertRule& rule, const AlertInput& input,
                       bool (*wanted)(const std::string& method, const std::string& code)) {
  const auto count = [&](const Selection& calls) {
    return Observed(calls, WindowOf(rule, input)).count;
  };
  const double all = count(input.history.Select("spikeserve_rpc_duration_seconds"));
  const double share = count(SelectCalls(input.history, wanted)) / all;  // 0 / 0 is above nothing
  return ServerIf(share > rule.threshold, share);
}

Instances Down(const AlertRule& /*rule*/, const AlertInput& /*input*/) { return {}; }

Instances Errors(const AlertRule& rule, const AlertInput& input) {
  return ShareOfCalls(rule, input, [](const std::string& /*method*/, const std::string& code) {
    return IsServerError(code);
  });
}

Instances CallsRefused(const AlertRule& rule, const AlertInput& input) {
  return ShareOfCalls(rule, input, [](const std::string& /*method*/, const std::string& code) {
    return IsAgentMistake(code);
  });
}

Instances Slow(const AlertRule& rule, const AlertInput& input) {
  const Selection acts =
      SelectCalls(input.history, [](const std::string& method, const std::string& /*code*/) {
        return method == "Act" || method == "ActStream";
      });
  const double p99 = Quantile(Observed(acts, WindowOf(rule, input)), 0.99);
  return ServerIf(p99 > rule.threshold, p99);
}

Instances UnusualObservations(const AlertRule& rule, const AlertInput& input) {
  Instances found;
  const Selection unusual = input.history.Select("spikeserve_unusual_observations_total");
  for (const auto& [labels, series] : GroupBy({"policy", "version", "element"}, unusual)) {
    const double count = Increase(series, WindowOf(rule, input));
    if (count == 0.0) continue;
    MetricLabels version = labels;
    version.erase("element");
    const double share =
        count / Increase(input.history.Select("spikeserve_decisions_total", version),
                         WindowOf(rule, input));
    if (share > rule.threshold) found.push_back({labels, share});
  }
  return found;
}

Instances NonFiniteAnswers(const AlertRule& rule, const AlertInput& input) {
  Instances found;
  const Selection answers = input.history.Select("spikeserve_non_finite_answers_total");
  for (const auto& [labels, series] : GroupBy({"policy", "version"}, answers)) {
    const double count = Increase(series, WindowOf(rule, input));
    if (count > rule.threshold) found.push_back({labels, count});
  }
  return found;
}

Instances NoDecisions(const AlertRule& rule, const AlertInput& input) {
  const double sessions = Gauge(input.history.Select("spikeserve_sessions"));
  const double decisions =
      Increase(input.history.Select("spikeserve_decisions_total"), WindowOf(rule, input));
  return ServerIf(sessions > rule.threshold && decisions == 0.0, sessions);
}

Instances SessionsNearLimit(const AlertRule& rule, const AlertInput& input) {
  const double share = Gauge(input.history.Select("spikeserve_sessions")) /
                       Gauge(input.history.Select("spikeserve_sessions_limit"));
  return ServerIf(share > rule.threshold, share);
}

// Compares medians, because the sum of a histogram of negative returns decreases, which Prometheus
// takes for a restart.
Instances ReturnFalling(const AlertRule& rule, const AlertInput& input) {
  Instances found;
  const TimeSpan window = WindowOf(rule, input);
  const TimeSpan day_before = {.from = window.from - absl::Hours(24), .to = window.from};
  const Selection returns = input.history.Select("spikeserve_episode_return");
  for (const auto& [labels, series] : GroupBy({"policy", "version"}, returns)) {
    const Distribution recent = Observed(series, window);
    if (recent.count < kFewestEpisodes) continue;
    const double before = Quantile(Observed(series, day_before), 0.5);
    const double fall = before - Quantile(recent, 0.5);
    if (fall > rule.threshold * std::abs(before)) found.push_back({labels, fall});
  }
  return found;
}

Instances LearningRolledBack(const AlertRule& rule, const AlertInput& input) {
  Instances found;
  const Selection rollbacks = input.history.Select("spikeserve_learning_rollbacks_total");
  for (const auto& [labels, series] : GroupBy({"policy", "version", "scope"}, rollbacks)) {
    const double count = Increase(series, WindowOf(rule, input));
    if (count > rule.threshold) found.push_back({labels, count});
  }
  return found;
}

Instances ShadowDisagrees(const AlertRule& rule, const AlertInput& input) {
  Instances found;
  const Selection shadowed = input.history.Select("spikeserve_shadow_decisions_total");
  for (const auto& [labels, series] : GroupBy({"policy", "version", "shadow_version"}, shadowed)) {
    const double all = Increase(series, WindowOf(rule, input));
    MetricLabels differing = labels;
    differing["agreement"] = "differ";
    const double differ =
        Increase(input.history.Select("spikeserve_shadow_decisions_total", differing),
                 WindowOf(rule, input));
    if (all >= kFewestShadowDecisions && differ / all > rule.threshold) {
      found.push_back({labels, differ / all});
    }
  }
  return found;
}

Instances RolloutAborted(const AlertRule& rule, const AlertInput& input) {
  Instances found;
  for (const MetricSeries* ended : input.history.Select(
           "spikeserve_policy_rollout_ended_timestamp_seconds", {{"state", "aborted"}})) {
    const double ago = input.unix_seconds - ended->raw[0];
    if (ended->present && ago < rule.threshold) found.push_back({ended->labels, ago});
  }
  return found;
}

Instances RolloutDisputed(const AlertRule& rule, const AlertInput& input) {
  Instances found;
  for (const MetricSeries* disputed : input.history.Select("spikeserve_policy_rollout_disputed")) {
    const double value = disputed->raw[0];
    if (disputed->present && value > rule.threshold) found.push_back({disputed->labels, value});
  }
  return found;
}

Instances StoreUnreachable(const AlertRule& rule, const AlertInput& input) {
  const Selection reachable = input.history.Select("spikeserve_store_reachable");
  const double value = Gauge(reachable);
  return ServerIf(!reachable.empty() && value < rule.threshold, value);
}

Instances StoreSlow(const AlertRule& rule, const AlertInput& input) {
  const Selection waits = input.history.Select("spikeserve_store_acknowledgement_seconds");
  const double p99 = Quantile(Observed(waits, WindowOf(rule, input)), 0.99);
  return ServerIf(p99 > rule.threshold, p99);
}

Instances SessionsBounce(const AlertRule& rule, const AlertInput& input) {
  const auto increase = [&](const char* counter) {
    return Increase(input.history.Select(counter), WindowOf(rule, input));
  };
  const double fences = increase("spikeserve_store_fences_total");
  const double records = increase("spikeserve_store_records_total");
  return ServerIf(fences > rule.threshold * records, fences / absl::ToDoubleSeconds(rule.window));
}

Instances HeadLogCut(const AlertRule& rule, const AlertInput& input) {
  const double cuts =
      Increase(input.history.Select("spikeserve_head_log_reloads_total", {{"outcome", "cut"}}),
               WindowOf(rule, input));
  return ServerIf(cuts > rule.threshold, cuts);
}

Instances CertificateExpires(const AlertRule& rule, const AlertInput& input) {
  Instances found;
  for (const MetricSeries* expiry :
       input.history.Select("spikeserve_tls_expiry_timestamp_seconds")) {
    const double left = expiry->raw[0] - input.unix_seconds;
    if (expiry->present && left < rule.threshold) found.push_back({expiry->labels, left});
  }
  return found;
}

Instances CertificateNotReloaded(const AlertRule& rule, const AlertInput& input) {
  const double failing = Gauge(input.history.Select("spikeserve_tls_reload_failing"));
  return ServerIf(failing > rule.threshold, failing);
}

Instances ConnectionsRefused(const AlertRule& rule, const AlertInput& input) {
  Instances found;
  for (const MetricSeries* refused : input.history.Select("spikeserve_connections_refused_total")) {
    const double connections = Increase({refused}, WindowOf(rule, input));
    if (connections > rule.threshold) found.push_back({refused->labels, connections});
  }
  return found;
}

// Robots that report no beats and ask again for answers that came too late.
constexpr double kMostRepeated = 0.2;

Instances RobotsWithoutActions(const AlertRule& rule, const AlertInput& input) {
  Instances found;
  const TimeSpan window = WindowOf(rule, input);
  const auto increase = [&](const char* counter, const MetricLabels& labels) {
    return Increase(input.history.Select(counter, labels), window);
  };
  const Selection decided = input.history.Select("spikeserve_decisions_total");
  for (const auto& [labels, decisions] : GroupBy({"policy", "version"}, decided)) {
    const double beats = increase("spikeserve_beats_total", labels);
    MetricLabels fresh = labels;
    fresh["source"] = "fresh";
    const double missed = 1.0 - increase("spikeserve_beats_total", fresh) / beats;
    const double repeated = increase("spikeserve_repeated_requests_total", labels);
    const double share = repeated / (repeated + Increase(decisions, window));
    if (missed > rule.threshold) {
      found.push_back({labels, missed});
    } else if (share > kMostRepeated) {
      found.push_back({labels, share});
    }
  }
  return found;
}

Instances RobotsBlind(const AlertRule& rule, const AlertInput& input) {
  Instances found;
  const Selection invalid = input.history.Select("spikeserve_invalid_observations_total");
  for (const auto& [labels, series] : GroupBy({"policy", "version"}, invalid)) {
    const double beats = Increase(series, WindowOf(rule, input));
    if (beats > rule.threshold) found.push_back({labels, beats});
  }
  return found;
}

Instances RobotsSilent(const AlertRule& rule, const AlertInput& input) {
  const double silent = Gauge(input.history.Select("spikeserve_silent_robots"));
  return ServerIf(silent > rule.threshold, silent);
}

constexpr absl::Duration kNow = absl::ZeroDuration();

const std::vector<AlertRule>& Rules() {
  static const auto* const rules = new std::vector<AlertRule>{
      {"SpikeserveDown", "critical", "The server does not answer.", 0.0, kNow, absl::Minutes(1),
       Down},
      {"SpikeserveErrors", "critical", "Calls fail because of the server or its limits.", 0.01,
       absl::Minutes(5), absl::Minutes(5), Errors},
      {"SpikeserveCallsRefused", "warning", "Calls are refused because of mistakes of agents.",
       0.05, absl::Minutes(5), absl::Minutes(5), CallsRefused},
      {"SpikeserveSlow", "warning",
       "The slowest 1 % of the decisions' calls take too long, in seconds.", 0.025,
       absl::Minutes(5), absl::Minutes(5), Slow},
      {"SpikeserveUnusualObservations", "warning",
       "An element of the observations is far outside the training data.", 0.05, absl::Minutes(5),
       absl::Minutes(5), UnusualObservations},
      {"SpikeserveNonFiniteAnswers", "critical", "Answers held NaN or infinity and were not sent.",
       0.0, absl::Minutes(15), kNow, NonFiniteAnswers},
      {"SpikeserveNoDecisions", "critical", "Sessions are open and receive no decisions.", 0.0,
       absl::Minutes(5), absl::Minutes(10), NoDecisions},
      {"SpikeserveSessionsNearLimit", "warning", "Most of --max_sessions are open.", 0.8, kNow,
       absl::Minutes(5), SessionsNearLimit},
      {"SpikeserveReturnFalling", "warning",
       "The median return of the last 30 minutes is below that of the day before.", 0.1,
       absl::Minutes(30), absl::Minutes(5), ReturnFalling},
      {"SpikeserveLearningRolledBack", "warning", "The guard rolled a learned head back.", 0.0,
       absl::Minutes(15), kNow, LearningRolledBack},
      {"SpikeserveShadowDisagrees", "warning",
       "The shadow chooses other actions than the version that it shadows.", 0.1, absl::Minutes(30),
       absl::Minutes(5), ShadowDisagrees},
      {"SpikeserveRolloutAborted", "warning", "The server aborted a roll-out, seconds ago.", 3600.0,
       kNow, kNow, RolloutAborted},
      {"SpikeserveRolloutDisputed", "warning",
       "A roll-out waits, because one tenant's sessions decide whether the version is worse.", 0.0,
       kNow, absl::Minutes(5), RolloutDisputed},
      {"SpikeserveStoreUnreachable", "critical", "The server cannot reach its session store.", 1.0,
       kNow, absl::Minutes(1), StoreUnreachable},
      {"SpikeserveStoreSlow", "warning",
       "The session store acknowledges the slowest 1 % of the records late, in seconds.", 0.1,
       absl::Minutes(5), absl::Minutes(5), StoreSlow},
      {"SpikeserveSessionsBounce", "warning",
       "Several servers take sessions from each other, for each record that is stored.", 0.01,
       absl::Minutes(5), absl::Minutes(5), SessionsBounce},
      {"SpikeserveHeadLogCut", "critical",
       "Entries of the log of a shared head were lost, and the log was cut before them.", 0.0,
       absl::Minutes(15), kNow, HeadLogCut},
      {"SpikeserveCertificateExpires", "critical",
       "A certificate of TLS expires soon, in seconds from now.", 14.0 * 86400.0, kNow, kNow,
       CertificateExpires},
      {"SpikeserveCertificateNotReloaded", "warning",
       "The new files of TLS cannot be used; the old ones are.", 0.0, kNow, absl::Minutes(1),
       CertificateNotReloaded},
      {"SpikeserveConnectionsRefused", "warning",
       "Connections are refused by the limit that the label names.", 0.0, absl::Minutes(5),
       absl::Minutes(5), ConnectionsRefused},
      {"SpikeserveRobotsWithoutActions", "warning",
       "Robots play beats without a fresh action, or ask again for answers that were late.", 0.05,
       absl::Minutes(2), kNow, RobotsWithoutActions},
      {"SpikeserveRobotsBlind", "warning",
       "Robots play beats without a valid observation, minute after minute.", 0.0, absl::Minutes(2),
       absl::Minutes(2), RobotsBlind},
      {"SpikeserveRobotsSilent", "warning",
       "Robots that declared their period have sent nothing for 50 periods.", 0.0, kNow, kNow,
       RobotsSilent},
  };
  return *rules;
}

}  // namespace

void Alerts::Evaluate(const MetricHistory& history, absl::Duration now, double unix_seconds) {
  now_ = now;
  decltype(active_) active;
  for (const AlertRule& rule : Rules()) {
    for (AlertInstance& instance : rule.evaluate(rule, {history, now, unix_seconds})) {
      const auto key = std::make_pair(&rule, std::move(instance.labels));
      const auto before = active_.find(key);
      const absl::Duration since = before == active_.end() ? now : before->second.since;
      active[key] = {.since = since, .value = instance.value};
    }
  }
  active_ = std::move(active);
}

Json Alerts::ToJson() const {
  Json list = Json::array();
  for (const AlertRule& rule : Rules()) {
    Json instances = Json::array();
    bool fires = false;
    for (const auto& [key, active] : active_) {
      if (key.first != &rule) continue;
      const absl::Duration held = now_ - active.since;
      const bool firing = held >= rule.wait;
      fires = fires || firing;
      instances.push_back({{"labels", key.second},
                           {"value", active.value},
                           {"seconds", absl::ToDoubleSeconds(held)},
                           {"state", firing ? "firing" : "pending"}});
    }
    list.push_back({{"name", rule.name},
                    {"severity", rule.severity},
                    {"description", rule.description},
                    {"threshold", rule.threshold},
                    {"window_seconds", absl::ToDoubleSeconds(rule.window)},
                    {"for_seconds", absl::ToDoubleSeconds(rule.wait)},
                    {"state", fires               ? "firing"
                              : instances.empty() ? "ok"
                                                  : "pending"},
                    {"instances", std::move(instances)}});
  }
  return list;
}

}  // namespace spikeserve
