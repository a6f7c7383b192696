#include "client/tools/latency_histogram.h"

#include <algorithm>
#include <cmath>

namespace spikeserve {
namespace {

constexpr double kSmallest = 1e-7;  // seconds: the lower edge of bucket 0
constexpr double kGrowth = 1.02;    // upper edge / lower edge; the centre is within 1 % of both
constexpr int kBuckets = 1164;      // kSmallest * kGrowth^kBuckets is 1000 seconds

int BucketOf(double seconds) {
  if (!(seconds > kSmallest)) return 0;
  const double bucket = std::log(seconds / kSmallest) / std::log(kGrowth);
  return static_cast<int>(std::min<double>(bucket, kBuckets - 1));
}

}  // namespace

LatencyHistogram::LatencyHistogram() : buckets_(kBuckets) {}

void LatencyHistogram::Add(double seconds) {
  ++buckets_[BucketOf(seconds)];
  min_ = count_ == 0 ? seconds : std::min(min_, seconds);
  max_ = count_ == 0 ? seconds : std::max(max_, seconds);
  ++count_;
}

void LatencyHistogram::Merge(const LatencyHistogram& other) {
  if (other.count_ == 0) return;
  for (int i = 0; i < kBuckets; ++i) buckets_[i] += other.buckets_[i];
  min_ = count_ == 0 ? other.min_ : std::min(min_, other.min_);
  max_ = count_ == 0 ? other.max_ : std::max(max_, other.max_);
  count_ += other.count_;
}

double LatencyHistogram::Quantile(double quantile) const {
  if (count_ == 0) return 0.0;
  const int64_t rank = std::max<int64_t>(1, static_cast<int64_t>(std::ceil(quantile * count_)));
  int64_t seen = 0;
  for (int i = 0; i < kBuckets; ++i) {
    seen += buckets_[i];
    if (seen >= rank) {
      return std::clamp(kSmallest * std::pow(kGrowth, i + 0.5), min_, max_);
    }
  }
  return max_;
}

}  // namespace spikeserve
