#include "server/history/alerts.h"

#include <cmath>
#include <initializer_list>
#include <string>
#include <utility>

#include "absl/functional/function_ref.h"
#include "server/history/figures.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;
using Instances = std::vector<AlertInstance>;

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
  return ServerIf(share > rule.figures[0], share);
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
  return ServerIf(p99 > rule.figures[0], p99);
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
    if (share > rule.figures[0]) found.push_back({labels, share});
  }
  return found;
}

// Returns the groups of series of which the counter `name` has increased by more than the figure.
Instances Counted(const char* name, std::initializer_list<const char*> by, const AlertRule& rule,
                  const AlertInput& input, const MetricLabels& of = {}) {
  Instances found;
  for (const auto& [labels, series] : GroupBy(by, input.history.Select(name, of))) {
    const double count = Increase(series, WindowOf(rule, input));
    if (count > rule.figures[0]) found.push_back({labels, count});
  }
  return found;
}

// Returns the series of which `value_of` the present value is above the figure, or below it.
Instances Present(const Selection& all, bool below, const AlertRule& rule,
                  absl::FunctionRef<double(double now)> value_of) {
  Instances found;
  for (const MetricSeries* series : all) {
    const double value = value_of(series->raw[0]);
    const bool holds = below ? value < rule.figures[0] : value > rule.figures[0];
    if (series->present && holds) found.push_back({series->labels, value});
  }
  return found;
}

double Itself(double value) { return value; }

Instances NonFiniteAnswers(const AlertRule& rule, const AlertInput& input) {
  return Counted("spikeserve_non_finite_answers_total", {"policy", "version"}, rule, input);
}

Instances RobotMiswired(const AlertRule& rule, const AlertInput& input) {
  return Counted("spikeserve_wiring_verdicts_total", {"policy", "version", "cause"}, rule, input);
}

Instances NoDecisions(const AlertRule& rule, const AlertInput& input) {
  const double sessions = Gauge(input.history.Select("spikeserve_sessions"));
  const double decisions =
      Increase(input.history.Select("spikeserve_decisions_total"), WindowOf(rule, input));
  return ServerIf(sessions > rule.figures[0] && decisions == 0.0, sessions);
}

Instances SessionsNearLimit(const AlertRule& rule, const AlertInput& input) {
  const double share = Gauge(input.history.Select("spikeserve_sessions")) /
                       Gauge(input.history.Select("spikeserve_sessions_limit"));
  return ServerIf(share > rule.figures[0], share);
}

Instances StorageNearLimit(const AlertRule& rule, const AlertInput& input) {
  Instances found;
  const Selection all = input.history.Select("spikeserve_stored_bytes");
  for (const auto& [folder, bytes] : GroupBy({"folder"}, all)) {
    const double share =  // 0 / 0, of a folder that is not used, is above nothing
        Gauge(bytes) / Gauge(input.history.Select("spikeserve_stored_bytes_limit", folder));
    if (share > rule.figures[0]) found.push_back({folder, share});
  }
  return found;
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
    if (recent.count < rule.figures[1]) continue;
    const double before = Quantile(Observed(series, day_before), 0.5);
    const double fall = before - Quantile(recent, 0.5);
    if (fall > rule.figures[0] * std::abs(before)) found.push_back({labels, fall});
  }
  return found;
}

Instances LearningRolledBack(const AlertRule& rule, const AlertInput& input) {
  return Counted("spikeserve_learning_rollbacks_total", {"policy", "version", "scope"}, rule,
                 input);
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
    if (all >= rule.figures[1] && differ / all > rule.figures[0]) {
      found.push_back({labels, differ / all});
    }
  }
  return found;
}

Instances RolloutAborted(const AlertRule& rule, const AlertInput& input) {
  const Selection ended = input.history.Select("spikeserve_policy_rollout_ended_timestamp_seconds",
                                               {{"state", "aborted"}});
  return Present(ended, /*below=*/true, rule, [&](double end) { return input.unix_seconds - end; });
}

Instances RolloutDisputed(const AlertRule& rule, const AlertInput& input) {
  return Present(input.history.Select("spikeserve_policy_rollout_disputed"), /*below=*/false, rule,
                 Itself);
}

Instances StoreUnreachable(const AlertRule& rule, const AlertInput& input) {
  const Selection reachable = input.history.Select("spikeserve_store_reachable");
  const double value = Gauge(reachable);
  return ServerIf(!reachable.empty() && value < rule.figures[0], value);
}

Instances StoreSlow(const AlertRule& rule, const AlertInput& input) {
  const Selection waits = input.history.Select("spikeserve_store_acknowledgement_seconds");
  const double p99 = Quantile(Observed(waits, WindowOf(rule, input)), 0.99);
  return ServerIf(p99 > rule.figures[0], p99);
}

Instances SessionsBounce(const AlertRule& rule, const AlertInput& input) {
  const auto increase = [&](const char* counter) {
    return Increase(input.history.Select(counter), WindowOf(rule, input));
  };
  const double fences = increase("spikeserve_store_fences_total");
  const double records = increase("spikeserve_store_records_total");
  return ServerIf(fences > rule.figures[0] * records, fences / absl::ToDoubleSeconds(rule.window));
}

Instances HeadLogCut(const AlertRule& rule, const AlertInput& input) {
  return Counted("spikeserve_head_log_reloads_total", {}, rule, input, {{"outcome", "cut"}});
}

Instances CertificateExpires(const AlertRule& rule, const AlertInput& input) {
  return Present(input.history.Select("spikeserve_tls_expiry_timestamp_seconds"), /*below=*/true,
                 rule, [&](double expiry) { return expiry - input.unix_seconds; });
}

Instances CertificateNotReloaded(const AlertRule& rule, const AlertInput& input) {
  const double failing = Gauge(input.history.Select("spikeserve_tls_reload_failing"));
  return ServerIf(failing > rule.figures[0], failing);
}

Instances ConnectionsRefused(const AlertRule& rule, const AlertInput& input) {
  return Counted("spikeserve_connections_refused_total", {"limit"}, rule, input);
}

// Robots that report no beats and ask again for answers that came too late: the second figure.
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
    if (missed > rule.figures[0]) {
      found.push_back({labels, missed});
    } else if (share > rule.figures[1]) {
      found.push_back({labels, share});
    }
  }
  return found;
}

Instances RobotsBlind(const AlertRule& rule, const AlertInput& input) {
  return Counted("spikeserve_invalid_observations_total", {"policy", "version"}, rule, input);
}

Instances RobotsSilent(const AlertRule& rule, const AlertInput& input) {
  const double silent = Gauge(input.history.Select("spikeserve_silent_robots"));
  return ServerIf(silent > rule.figures[0], silent);
}

Instances BudgetNearlySpent(const AlertRule& rule, const AlertInput& input) {
  return Present(input.history.Select("spikeserve_budget_ratio"), /*below=*/false, rule, Itself);
}

const std::vector<AlertRule>& AllRules() {
  static const auto* const rules = new std::vector<AlertRule>{
#include "alert_rules.inc"  // made of deploy/prometheus/alerts.yml by cmake/AlertRules.cmake
  };
  return *rules;
}

}  // namespace

void Alerts::Evaluate(const MetricHistory& history, absl::Duration now, double unix_seconds) {
  now_ = now;
  decltype(active_) active;
  for (const AlertRule& rule : AllRules()) {
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
  for (const AlertRule& rule : AllRules()) {
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
                    {"threshold", rule.figures[0]},
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
