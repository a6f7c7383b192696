// Evaluates the alerts of deploy/prometheus/alerts.yml in the server, so that the status page shows
// the same alerts as Prometheus without one. tests/python/web/test_alerts.py feeds both with the
// same figures and compares them.
//
//   Alerts alerts;
//   alerts.Evaluate(history, now, /*unix_seconds=*/1.8e9);  // whenever the history has grown
//   nlohmann::json list = alerts.ToJson();
//
// Not thread-safe.
#pragma once

#include <map>
#include <utility>
#include <vector>

#include "absl/time/time.h"
#include "nlohmann/json.hpp"
#include "server/history/metric_history.h"

namespace spikeserve {

struct AlertRule;

// One thing for which the condition of an alert holds.
struct AlertInstance {
  MetricLabels labels;  // such as policy and version; empty: the server
  double value;
};

// The arguments of a rule.
struct AlertInput {
  const MetricHistory& history;
  absl::Duration now;   // time of the history
  double unix_seconds;  // the same as Unix time
};

// A rule of deploy/prometheus/alerts.yml.
struct AlertRule {
  const char* name;
  const char* severity;         // critical or warning
  const char* description;      // what is wrong while it fires, as a sentence
  std::vector<double> figures;  // with which the expression compares, the threshold first
  absl::Duration window;        // over which the value is computed; zero: the present value
  absl::Duration wait;          // for which the condition must hold before the alert fires
  // Returns what the condition holds for.
  std::vector<AlertInstance> (*evaluate)(const AlertRule& rule, const AlertInput& input);
};

class Alerts {
 public:
  void Evaluate(const MetricHistory& history, absl::Duration now, double unix_seconds);

  // Returns every alert with its rule, its state (ok, pending or firing) and its instances.
  nlohmann::json ToJson() const;

 private:
  struct Active {
    absl::Duration since;
    double value;
  };

  absl::Duration now_ = absl::ZeroDuration();
  std::map<std::pair<const AlertRule*, MetricLabels>, Active> active_;
};

}  // namespace spikeserve
