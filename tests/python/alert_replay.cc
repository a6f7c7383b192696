// Evaluates the alerts of the status page over given metrics, for test_alerts.py.
//
// Reads JSON from standard input: {"ticks": [{"time": seconds, "metrics": {name: [series]}}]},
// where a series is
// {"labels", "value"}, or {"labels", "buckets"} with cumulative [upper bound, count] pairs, the
// last bound null. Prints one line for each tick: the alerts as in /status.json.
#include <iostream>
#include <limits>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/match.h"
#include "absl/time/time.h"
#include "nlohmann/json.hpp"
#include "prometheus/metric_family.h"
#include "server/history/alerts.h"
#include "server/history/metric_history.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

prometheus::ClientMetric ParseSeries(const Json& series) {
  prometheus::ClientMetric metric;
  for (const auto& [name, value] : series.at("labels").items()) {
    metric.label.push_back({.name = name, .value = value.get<std::string>()});
  }
  if (series.contains("value")) {
    metric.counter.value = metric.gauge.value = series.at("value").get<double>();
    return metric;
  }
  for (const Json& bucket : series.at("buckets")) {
    const double bound =
        bucket[0].is_null() ? std::numeric_limits<double>::infinity() : bucket[0].get<double>();
    metric.histogram.bucket.push_back(
        {.cumulative_count = bucket[1].get<uint64_t>(), .upper_bound = bound});
  }
  return metric;
}

std::vector<prometheus::MetricFamily> ParseMetrics(const Json& metrics) {
  std::vector<prometheus::MetricFamily> families;
  for (const auto& [name, all] : metrics.items()) {
    prometheus::MetricFamily family;
    family.name = name;
    family.type = absl::EndsWith(name, "_total") ? prometheus::MetricType::Counter
                                                 : prometheus::MetricType::Gauge;
    for (const Json& series : all) {
      if (series.contains("buckets")) family.type = prometheus::MetricType::Histogram;
      family.metric.push_back(ParseSeries(series));
    }
    families.push_back(std::move(family));
  }
  return families;
}

}  // namespace
}  // namespace spikeserve

int main() {
  spikeserve::MetricHistory history;
  spikeserve::Alerts alerts;
  const auto input = nlohmann::json::parse(std::cin);
  for (const auto& tick : input.at("ticks")) {
    const double time = tick.at("time").get<double>();
    history.Add(spikeserve::ParseMetrics(tick.at("metrics")), absl::Seconds(time));
    alerts.Evaluate(history, absl::Seconds(time), time);
    std::cout << alerts.ToJson() << "\n";
  }
}
