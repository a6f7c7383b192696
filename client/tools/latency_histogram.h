// Latencies in buckets whose width grows with the value: bounded memory for any number of them,
// quantiles within 1 %.
//
// A plain value, not thread-safe: each thread fills its own, and Merge adds them up.
#ifndef CLIENT_TOOLS_LATENCY_HISTOGRAM_H_
#define CLIENT_TOOLS_LATENCY_HISTOGRAM_H_

#include <cstdint>
#include <vector>

namespace spikeserve {

class LatencyHistogram {
 public:
  LatencyHistogram();

  // Values under 100 nanoseconds or over 1000 seconds count in the first or last bucket.
  void Add(double seconds);
  void Merge(const LatencyHistogram& other);

  int64_t count() const { return count_; }

  // The value that a share of `quantile` in [0, 1] of all values does not exceed, in seconds; 0 if
  // there are none.
  double Quantile(double quantile) const;

 private:
  std::vector<int64_t> buckets_;
  int64_t count_ = 0;
  double min_ = 0.0;
  double max_ = 0.0;
};

}  // namespace spikeserve

#endif  // CLIENT_TOOLS_LATENCY_HISTOGRAM_H_
