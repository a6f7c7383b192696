#include "server/history/metric_history.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "core/contract/dcheck.h"
#include "prometheus/metric_type.h"

namespace spikeserve {
namespace {

// The alerts look back 30 minutes exactly, and a day before that in steps of half an hour.
constexpr absl::Duration kExact = absl::Minutes(35);
constexpr absl::Duration kOldest = absl::Hours(25);
constexpr absl::Duration kCoarse = absl::Minutes(30);
constexpr absl::Duration kThinInterval = absl::Minutes(1);

int64_t SlotOf(absl::Duration time) { return absl::ToInt64Seconds(absl::Floor(time, kCoarse)); }

std::vector<double> ValuesOf(const prometheus::ClientMetric& metric, prometheus::MetricType type) {
  if (type == prometheus::MetricType::Counter) return {metric.counter.value};
  if (type == prometheus::MetricType::Gauge) return {metric.gauge.value};
  std::vector<double> values;
  for (const auto& bucket : metric.histogram.bucket) {
    values.push_back(static_cast<double>(bucket.cumulative_count));
  }
  values.push_back(metric.histogram.sample_sum);
  return values;
}

}  // namespace

void StepFunction::Add(absl::Duration time, double value) {
  SPIKESERVE_DCHECK(points_.empty() || time >= points_.back().first);
  if (!points_.empty() && points_.back().second == value) return;
  points_.emplace_back(time, value);
}

double StepFunction::At(absl::Duration time) const {
  const auto after = std::upper_bound(
      points_.begin(), points_.end(), time,
      [](absl::Duration wanted, const auto& point) { return wanted < point.first; });
  return after == points_.begin() ? 0.0 : std::prev(after)->second;
}

void StepFunction::Thin(absl::Duration exact, absl::Duration oldest) {
  std::vector<std::pair<absl::Duration, double>> kept;
  for (const auto& point : points_) {
    // A later point of the same half hour, or any point that is too old as well, replaces it.
    const bool replaces =
        !kept.empty() && point.first < exact &&
        (point.first <= oldest || SlotOf(kept.back().first) == SlotOf(point.first));
    if (replaces) kept.pop_back();
    kept.push_back(point);
  }
  points_ = std::move(kept);
}

void MetricHistory::Add(const std::vector<prometheus::MetricFamily>& families, absl::Duration now) {
  SPIKESERVE_DCHECK(empty_ || now >= end_);
  if (empty_) start_ = now;
  end_ = now;
  for (auto& [name, family] : families_) {
    for (auto& [labels, series] : family.series) series.present = false;
  }
  for (const prometheus::MetricFamily& family : families) {
    for (const auto& metric : family.metric) AddSeries(family.name, metric, family.type, now);
  }
  empty_ = false;
  Forget(now);
}

void MetricHistory::Index(const MetricSeries& series, Family* family) {
  MetricLabels version;
  for (const char* name : {"policy", "version"}) {
    const auto label = series.labels.find(name);
    if (label == series.labels.end()) return;
    version.insert(*label);
  }
  family->by_version[std::move(version)].push_back(&series);
}

void MetricHistory::AddSeries(const std::string& name, const prometheus::ClientMetric& metric,
                              prometheus::MetricType type, absl::Duration now) {
  MetricLabels labels;
  for (const auto& label : metric.label) labels.emplace(label.name, label.value);
  Family& family = families_[name];
  MetricSeries& series = family.series[labels];
  const std::vector<double> values = ValuesOf(metric, type);
  if (series.values.size() != values.size()) {
    const bool is_new = series.values.empty();
    series.labels = std::move(labels);
    if (is_new) Index(series, &family);
    series.bounds.clear();
    series.values.assign(values.size(), {});
    series.offsets.assign(values.size(), 0.0);
    series.raw.assign(values.size(), 0.0);
    for (const auto& bucket : metric.histogram.bucket) series.bounds.push_back(bucket.upper_bound);
  }
  series.seen = now;
  series.present = true;
  // The last bucket of a histogram counts all observations, whose sum may decrease without a reset.
  const size_t count = series.bounds.empty() ? 0 : series.bounds.size() - 1;
  const bool reset = type != prometheus::MetricType::Gauge && values[count] < series.raw[count];
  for (size_t i = 0; i < values.size(); ++i) {
    if (reset) series.offsets[i] += series.raw[i];
    series.raw[i] = values[i];
    // What was counted before the first call belongs to no window.
    series.values[i].Add(empty_ ? -absl::InfiniteDuration() : now, values[i] + series.offsets[i]);
  }
}

void MetricHistory::Forget(absl::Duration now) {
  if (now - thinned_ < kThinInterval) return;
  thinned_ = now;
  for (auto& [name, family] : families_) {
    for (auto& [labels, series] : family.series) {
      for (StepFunction& steps : series.values) steps.Thin(now - kExact, now - kOldest);
    }
    const size_t forgotten = std::erase_if(
        family.series, [&](const auto& item) { return item.second.seen < now - kOldest; });
    if (forgotten == 0) continue;
    family.by_version.clear();
    for (const auto& [labels, series] : family.series) Index(series, &family);
  }
}

Selection MetricHistory::Select(absl::string_view family, const MetricLabels& labels) const {
  Selection selection;
  const auto found = families_.find(family);
  if (found == families_.end()) return selection;
  const Family& all = found->second;
  if (labels.size() == 2 && labels.contains("policy") && labels.contains("version")) {
    const auto version = all.by_version.find(labels);
    return version == all.by_version.end() ? selection : version->second;
  }
  for (const auto& item : all.series) {
    const MetricSeries& series = item.second;
    const bool matches = std::all_of(labels.begin(), labels.end(), [&series](const auto& wanted) {
      const auto label = series.labels.find(wanted.first);
      return label != series.labels.end() && label->second == wanted.second;
    });
    if (matches) selection.push_back(&series);
  }
  return selection;
}

double Increase(const Selection& counters, TimeSpan span) {
  double sum = 0.0;
  for (const MetricSeries* counter : counters) {
    sum += counter->values[0].At(span.to) - counter->values[0].At(span.from);
  }
  return sum;
}

double Gauge(const Selection& gauges) {
  double sum = 0.0;
  for (const MetricSeries* gauge : gauges) {
    if (gauge->present) sum += gauge->raw[0];
  }
  return sum;
}

double GaugeAt(const Selection& gauges, absl::Duration time) {
  double sum = 0.0;
  for (const MetricSeries* gauge : gauges) {
    if (gauge->present || time <= gauge->seen) sum += gauge->values[0].At(time);
  }
  return sum;
}

Distribution Observed(const Selection& histograms, TimeSpan span) {
  Distribution all;
  for (const MetricSeries* histogram : histograms) {
    const size_t buckets = histogram->bounds.size();
    if (all.buckets.empty()) {
      for (const double bound : histogram->bounds) all.buckets.emplace_back(bound, 0.0);
    }
    SPIKESERVE_DCHECK_EQ(buckets, all.buckets.size());
    const auto change = [&](size_t i) {
      return histogram->values[i].At(span.to) - histogram->values[i].At(span.from);
    };
    for (size_t i = 0; i < std::min(buckets, all.buckets.size()); ++i) {
      all.buckets[i].second += change(i);
    }
    all.sum += change(buckets);
  }
  if (!all.buckets.empty()) all.count = all.buckets.back().second;
  return all;
}

double Quantile(const Distribution& distribution, double q) {
  if (distribution.count <= 0.0 || distribution.buckets.size() < 2) {
    return std::numeric_limits<double>::quiet_NaN();
  }
  const double rank = q * distribution.count;
  const auto& buckets = distribution.buckets;
  size_t i = 0;
  while (i + 1 < buckets.size() && buckets[i].second < rank) ++i;
  const double bound = buckets[i].first;
  if (std::isinf(bound)) return buckets[i - 1].first;  // i > 0: the first bound is finite
  const double lower = i == 0 ? std::min(0.0, bound) : buckets[i - 1].first;
  const double below = i == 0 ? 0.0 : buckets[i - 1].second;
  return lower + (bound - lower) * (rank - below) / (buckets[i].second - below);
}

}  // namespace spikeserve
