// Keeps the metrics of the last day in memory, so that figures over a window of time need no
// Prometheus.
//
//   MetricHistory history;
//   history.Add(metrics.Collect(), clock.Now());  // every few seconds
//   const auto decisions = history.Select("spikeserve_decisions_total", {{"policy", "cartpole"}});
//   double last_minute = Increase(decisions, {.from = now - absl::Minutes(1), .to = now});
//
// Stores the changes of each value only, so a policy version without traffic needs next to no
// memory. Values of the last 35 minutes are exact, older ones are kept for each half hour.
//
// Not thread-safe.
#pragma once

#include <map>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "prometheus/metric_family.h"

namespace spikeserve {

using MetricLabels = std::map<std::string, std::string>;

// A value over time, as a step function.
class StepFunction {
 public:
  // REQUIRES: `time` is not before the last one.
  void Add(absl::Duration time, double value);
  // Returns the value at `time`; 0 before the first one.
  double At(absl::Duration time) const;
  double last() const { return points_.empty() ? 0.0 : points_.back().second; }
  // Keeps one point for each half hour before `exact`, and none before `oldest` but the last.
  void Thin(absl::Duration exact, absl::Duration oldest);

 private:
  std::vector<std::pair<absl::Duration, double>> points_;  // by time, only changes
};

// The history of one time series. Counters and histograms continue after a reset.
struct MetricSeries {
  MetricLabels labels;
  std::vector<double> bounds;  // upper bounds of a histogram's buckets; otherwise empty
  // Of a counter or a gauge one element; of a histogram the cumulative counts of its buckets, and
  // last the sum of its observations.
  std::vector<StepFunction> values;
  std::vector<double> offsets = {};  // what resets have taken away, by element of `values`
  std::vector<double> raw = {};      // as exported last, by element of `values`
  absl::Duration seen = {};          // when it was exported last
  bool present = true;               // true: it was exported last time
};

using Selection = std::vector<const MetricSeries*>;

// The time in (from, to].
struct TimeSpan {
  absl::Duration from;
  absl::Duration to;
};

// What was observed in a histogram, or in several, during a window.
struct Distribution {
  double count = 0.0;
  double sum = 0.0;
  std::vector<std::pair<double, double>> buckets = {};  // upper bound, cumulative count
};

class MetricHistory {
 public:
  // Adds the present values. Counts of the first call are the start of all counting.
  void Add(const std::vector<prometheus::MetricFamily>& families, absl::Duration now);

  // Returns the series of a family whose labels include `labels`, also those that are not exported
  // any more. The pointers are valid until the next Add. Looks at no series of another version if
  // `labels` are a policy and a version.
  Selection Select(absl::string_view family, const MetricLabels& labels = {}) const;

  // The time of the first and the last Add. Zero before.
  absl::Duration start() const { return start_; }
  absl::Duration end() const { return end_; }

 private:
  void AddSeries(const std::string& family, const prometheus::ClientMetric& metric,
                 prometheus::MetricType type, absl::Duration now);
  void Forget(absl::Duration now);

  // The series of one name.
  struct Family {
    std::map<MetricLabels, MetricSeries> series;
    std::map<MetricLabels, Selection> by_version;  // by the labels policy and version alone
  };

  // Adds a series to the index of its family.
  static void Index(const MetricSeries& series, Family* family);

  std::map<std::string, Family, std::less<>> families_;
  bool empty_ = true;
  absl::Duration start_ = absl::ZeroDuration();
  absl::Duration end_ = absl::ZeroDuration();
  absl::Duration thinned_ = absl::ZeroDuration();
};

// Returns the increase of counters during a window, added up.
double Increase(const Selection& counters, TimeSpan span);
// Returns the sum of the gauges that are exported now.
double Gauge(const Selection& gauges);
// Returns the sum of the gauges at a time.
double GaugeAt(const Selection& gauges, absl::Duration time);
// Returns what the histograms observed during a window. REQUIRES: all have the same buckets.
Distribution Observed(const Selection& histograms, TimeSpan span);

// Returns the quantile `q` in [0, 1] as Prometheus estimates it, by interpolation within a bucket,
// and the last finite bound for a quantile beyond it. Returns NaN without observations, or without
// a finite bound.
double Quantile(const Distribution& distribution, double q);

}  // namespace spikeserve
