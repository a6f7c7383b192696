#include "client/tools/latency_histogram.h"

#include "gtest/gtest.h"

namespace spikeserve {
namespace {

TEST(LatencyHistogramTest, EmptyIsZero) {
  const LatencyHistogram histogram;
  EXPECT_EQ(histogram.count(), 0);
  EXPECT_EQ(histogram.Quantile(0.5), 0.0);
}

TEST(LatencyHistogramTest, QuantilesAreWithinOnePercent) {
  LatencyHistogram histogram;
  for (int i = 1; i <= 1000; ++i) histogram.Add(i * 1e-5);
  EXPECT_EQ(histogram.count(), 1000);
  EXPECT_NEAR(histogram.Quantile(0.5), 500e-5, 5e-5);
  EXPECT_NEAR(histogram.Quantile(0.99), 990e-5, 9.9e-5);
  EXPECT_NEAR(histogram.Quantile(0.0), 1e-5, 1e-7);
  EXPECT_NEAR(histogram.Quantile(1.0), 1000e-5, 10e-5);
}

TEST(LatencyHistogramTest, OneValueIsExact) {
  LatencyHistogram histogram;
  histogram.Add(0.0123);
  EXPECT_EQ(histogram.Quantile(0.5), 0.0123);
  EXPECT_EQ(histogram.Quantile(0.99), 0.0123);
}

TEST(LatencyHistogramTest, MergeIsAddingAll) {
  LatencyHistogram all, first, second;
  for (int i = 1; i <= 100; ++i) {
    all.Add(i * 1e-3);
    (i % 3 == 0 ? first : second).Add(i * 1e-3);
  }
  LatencyHistogram merged;
  merged.Merge(first);
  merged.Merge(second);
  merged.Merge(LatencyHistogram());
  EXPECT_EQ(merged.count(), 100);
  for (const double quantile : {0.0, 0.5, 0.9, 0.99, 1.0}) {
    EXPECT_EQ(merged.Quantile(quantile), all.Quantile(quantile));
  }
}

TEST(LatencyHistogramTest, ExtremesDoNotEscape) {
  LatencyHistogram histogram;
  histogram.Add(0.0);
  histogram.Add(1e9);
  EXPECT_EQ(histogram.count(), 2);
  EXPECT_GE(histogram.Quantile(0.5), 0.0);
  EXPECT_GT(histogram.Quantile(1.0), 900.0);
}

}  // namespace
}  // namespace spikeserve
