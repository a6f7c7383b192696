// A histogram of latencies with exponentially growing buckets: memory is constant, and quantiles
// are within 1 % of the exact value.
//
//   LatencyHistogram latencies;
//   latencies.Add(/*seconds=*/0.0021);
//   double p99 = latencies.Quantile(0.99);
//
// A plain value, not thread-safe. Each thread fills its own; Merge combines them.
#pragma once

#include <cstdint>
#include <vector>

namespace spikeserve {

class LatencyHistogram {
 public:
  LatencyHistogram();

  // Adds one latency. Values below 100 nanoseconds count in the first bucket, values above 1000
  // seconds in the last.
  void Add(double seconds);
  // Adds all latencies of `other`.
  void Merge(const LatencyHistogram& other);

  int64_t count() const { return count_; }

  // Returns the `quantile`-quantile in seconds, with `quantile` in [0, 1]; 0 if there are no
  // values.
  double Quantile(double quantile) const;

 private:
  std::vector<int64_t> buckets_;
  int64_t count_ = 0;
  double min_ = 0.0;
  double max_ = 0.0;
};

}  // namespace spikeserve
