// The measurements of a load test.
//
// A plain value, not thread-safe: each caller fills its own report, and Merge adds them up.
#pragma once

#include <cstdint>
#include <string>

#include "absl/status/status.h"
#include "client/tools/latency_histogram.h"
#include "nlohmann/json.hpp"

namespace spikeserve {

struct LoadReport {
  int64_t decisions = 0;     // requests that were answered with a decision
  int64_t errors = 0;        // failed attempts; a repeated request counts once per failure
  double seconds = 0.0;      // from the first request to the last answer
  LatencyHistogram latency;  // seconds from the time a request was due to the arrival of its answer
  LatencyHistogram longest;  // the longest of these seconds of each session
  absl::Status first_error;  // OK if errors == 0

  void CountError(const absl::Status& error);
  // Adds the report of a caller that ran concurrently: `seconds` becomes the larger of the two.
  void Merge(const LoadReport& other);
  double DecisionsPerSecond() const;

  std::string ToText() const;
  // Returns an object with `decisions`, `decisions_per_second`, `p50_seconds`, `p99_seconds`,
  // `longest_wait_p50_seconds`, `longest_wait_p99_seconds` and `errors`.
  nlohmann::ordered_json ToJson() const;
};

}  // namespace spikeserve
