// What a load test measured.
//
// Plain values, not thread-safe: each caller fills its own, and Merge adds them up.
#ifndef LOADTEST_LOAD_REPORT_H_
#define LOADTEST_LOAD_REPORT_H_

#include <cstdint>
#include <string>

#include "absl/status/status.h"
#include "client/tools/latency_histogram.h"
#include "nlohmann/json.hpp"

namespace spikeserve {

struct LoadReport {
  int64_t decisions = 0;     // answered
  int64_t errors = 0;        // requests that failed, repeated ones each time
  double seconds = 0.0;      // from the first request to the last answer
  LatencyHistogram latency;  // seconds from when a request was due to the arrival of its answer
  absl::Status first_error;

  void CountError(const absl::Status& error);
  // Adds up callers who ran side by side.
  void Merge(const LoadReport& other);
  double DecisionsPerSecond() const;

  std::string ToText() const;
  // `decisions`, `decisions_per_second`, `p50_seconds`, `p99_seconds`, `errors`.
  nlohmann::ordered_json ToJson() const;
};

}  // namespace spikeserve

#endif  // LOADTEST_LOAD_REPORT_H_
