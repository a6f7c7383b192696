// The measurements of a load test.
//
// A plain value, not thread-safe: each caller fills its own report, and Merge adds them up.
#pragma once

#include <algorithm>
#include <cstdint>
#include <string>

#include "absl/status/status.h"
#include "absl/strings/str_format.h"
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

  void CountError(const absl::Status& error) {
    if (errors == 0) first_error = error;
    ++errors;
  }

  // Adds the report of a caller that ran concurrently: `seconds` becomes the larger of the two.
  void Merge(const LoadReport& other) {
    if (errors == 0) first_error = other.first_error;
    decisions += other.decisions;
    errors += other.errors;
    seconds = std::max(seconds, other.seconds);
    latency.Merge(other.latency);
    longest.Merge(other.longest);
  }

  double DecisionsPerSecond() const {
    return seconds > 0.0 ? static_cast<double>(decisions) / seconds : 0.0;
  }

  std::string ToText() const {
    constexpr double kMilli = 1e3;
    return absl::StrFormat(
        "%d decisions in %.1f s, %.1f decisions/s\nlatency p50 %.3f ms, p99 %.3f ms\n"
        "longest wait of a session p50 %.3f ms, p99 %.3f ms\n%d errors\n",
        decisions, seconds, DecisionsPerSecond(), latency.Quantile(0.5) * kMilli,
        latency.Quantile(0.99) * kMilli, longest.Quantile(0.5) * kMilli,
        longest.Quantile(0.99) * kMilli, errors);
  }

  // Returns an object with `decisions`, `decisions_per_second`, `p50_seconds`, `p99_seconds`,
  // `longest_wait_p50_seconds`, `longest_wait_p99_seconds` and `errors`.
  nlohmann::ordered_json ToJson() const {
    return {{"decisions", decisions},
            {"decisions_per_second", DecisionsPerSecond()},
            {"p50_seconds", latency.Quantile(0.5)},
            {"p99_seconds", latency.Quantile(0.99)},
            {"longest_wait_p50_seconds", longest.Quantile(0.5)},
            {"longest_wait_p99_seconds", longest.Quantile(0.99)},
            {"errors", errors}};
  }
};

}  // namespace spikeserve
