// Tests the history of metrics: windows, resets, versions that come and go, and old values.
#include "server/history/metric_history.h"

#include <cmath>
#include <cstdint>
#include <limits>
#include <string>
#include <vector>

#include "gtest/gtest.h"
#include "prometheus/client_metric.h"

namespace spikeserve {
namespace {

using prometheus::ClientMetric;
using prometheus::MetricFamily;
using prometheus::MetricType;

constexpr double kInfinity = std::numeric_limits<double>::infinity();

ClientMetric Labelled(const std::string& version) {
  ClientMetric metric;
  metric.label = {{.name = "version", .value = version}};
  return metric;
}

MetricFamily Counter(const std::string& version, double value) {
  ClientMetric metric = Labelled(version);
  metric.counter.value = value;
  return {.name = "decisions", .help = "", .type = MetricType::Counter, .metric = {metric}};
}

MetricFamily Gauge(const std::string& version, double value) {
  ClientMetric metric = Labelled(version);
  metric.gauge.value = value;
  return {.name = "sessions", .help = "", .type = MetricType::Gauge, .metric = {metric}};
}

MetricFamily Histogram(uint64_t below_ten, uint64_t all, double sum) {
  ClientMetric metric = Labelled("1");
  metric.histogram.sample_count = all;
  metric.histogram.sample_sum = sum;
  metric.histogram.bucket = {{.cumulative_count = below_ten, .upper_bound = 10.0},
                             {.cumulative_count = all, .upper_bound = kInfinity}};
  return {.name = "returns", .help = "", .type = MetricType::Histogram, .metric = {metric}};
}

TimeSpan Minutes(int from, int to) { return {absl::Minutes(from), absl::Minutes(to)}; }

TEST(MetricHistoryTest, CountsWithinAWindow) {
  MetricHistory history;
  for (int minute = 0; minute <= 10; ++minute) {
    history.Add({Counter("1", 5.0 * minute)}, absl::Minutes(minute));
  }
  EXPECT_EQ(Increase(history.Select("decisions"), Minutes(2, 4)), 10.0);
  EXPECT_EQ(Increase(history.Select("decisions", {{"version", "2"}}), Minutes(2, 4)), 0.0);
  EXPECT_EQ(Increase(history.Select("unknown"), Minutes(2, 4)), 0.0);
}

TEST(MetricHistoryTest, WhatWasCountedBeforeItStartsBelongsToNoWindow) {
  MetricHistory history;
  history.Add({Counter("1", 100.0)}, absl::Minutes(1));
  history.Add({Counter("1", 101.0)}, absl::Minutes(2));
  EXPECT_EQ(Increase(history.Select("decisions"), Minutes(0, 2)), 1.0);
  // A series that appears later started at zero.
  history.Add({Counter("1", 101.0), Counter("2", 7.0)}, absl::Minutes(3));
  EXPECT_EQ(Increase(history.Select("decisions"), Minutes(2, 3)), 7.0);
}

TEST(MetricHistoryTest, CountingContinuesAfterAReset) {
  MetricHistory history;
  history.Add({Counter("1", 0.0), Histogram(0, 0, 0.0)}, absl::Minutes(0));
  history.Add({Counter("1", 10.0), Histogram(2, 3, -20.0)}, absl::Minutes(1));
  history.Add({Counter("1", 4.0), Histogram(0, 1, 50.0)}, absl::Minutes(2));
  EXPECT_EQ(Increase(history.Select("decisions"), Minutes(0, 2)), 14.0);
  const Distribution returns = Observed(history.Select("returns"), Minutes(0, 2));
  EXPECT_EQ(returns.count, 4.0);
  EXPECT_EQ(returns.sum, 30.0);
}

// A sum of negative returns decreases without a reset.
TEST(MetricHistoryTest, ASumMayDecrease) {
  MetricHistory history;
  history.Add({Histogram(0, 0, 0.0)}, absl::Minutes(0));
  history.Add({Histogram(1, 1, -200.0)}, absl::Minutes(1));
  history.Add({Histogram(2, 2, -500.0)}, absl::Minutes(2));
  EXPECT_EQ(Observed(history.Select("returns"), Minutes(1, 2)).sum, -300.0);
}

TEST(MetricHistoryTest, AGaugeEndsWithItsVersion) {
  MetricHistory history;
  history.Add({Gauge("1", 3.0), Gauge("2", 4.0)}, absl::Minutes(0));
  history.Add({Gauge("1", 3.0)}, absl::Minutes(1));
  const Selection sessions = history.Select("sessions");
  EXPECT_EQ(Gauge(sessions), 3.0);
  EXPECT_EQ(GaugeAt(sessions, absl::Minutes(1)), 3.0);
  EXPECT_EQ(GaugeAt(sessions, absl::Minutes(0)), 7.0);
}

TEST(MetricHistoryTest, OldValuesAreKeptForEachHalfHour) {
  MetricHistory history;
  const int day = 24 * 60;
  for (int minute = 0; minute <= 2 * day; ++minute) {
    history.Add({Counter("1", minute)}, absl::Minutes(minute));
  }
  const Selection decisions = history.Select("decisions");
  const int end = 2 * day;
  EXPECT_EQ(Increase(decisions, Minutes(end - 30, end)), 30.0);
  EXPECT_NEAR(Increase(decisions, Minutes(end - day, end)), day, 30.0);
  EXPECT_NEAR(Increase(decisions, Minutes(end - day - 30, end - 30)), day, 30.0);
  EXPECT_EQ(Increase(decisions, {absl::ZeroDuration(), absl::Minutes(end)}), end);
}

TEST(QuantileTest, InterpolatesWithinABucket) {
  EXPECT_TRUE(std::isnan(Quantile({}, 0.5)));
  const Distribution some = {.count = 4.0,
                             .buckets = {{-10.0, 1.0}, {0.0, 2.0}, {10.0, 4.0}, {kInfinity, 4.0}}};
  EXPECT_EQ(Quantile(some, 0.75), 5.0);
  EXPECT_EQ(Quantile(some, 0.25), -10.0);
  const Distribution beyond = {.count = 4.0, .buckets = {{10.0, 1.0}, {kInfinity, 4.0}}};
  EXPECT_EQ(Quantile(beyond, 0.99), 10.0);
}

}  // namespace
}  // namespace spikeserve
