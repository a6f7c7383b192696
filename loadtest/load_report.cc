#include "loadtest/load_report.h"

#include <algorithm>

#include "absl/strings/str_format.h"

namespace spikeserve {

void LoadReport::CountError(const absl::Status& error) {
  if (errors == 0) first_error = error;
  ++errors;
}

void LoadReport::Merge(const LoadReport& other) {
  if (errors == 0) first_error = other.first_error;
  decisions += other.decisions;
  errors += other.errors;
  seconds = std::max(seconds, other.seconds);
  latency.Merge(other.latency);
  longest.Merge(other.longest);
}

double LoadReport::DecisionsPerSecond() const {
  return seconds > 0.0 ? static_cast<double>(decisions) / seconds : 0.0;
}

std::string LoadReport::ToText() const {
  constexpr double kMilli = 1e3;
  return absl::StrFormat(
      "%d decisions in %.1f s, %.1f decisions/s\nlatency p50 %.3f ms, p99 %.3f ms\n"
      "longest wait of a session p50 %.3f ms, p99 %.3f ms\n%d errors\n",
      decisions, seconds, DecisionsPerSecond(), latency.Quantile(0.5) * kMilli,
      latency.Quantile(0.99) * kMilli, longest.Quantile(0.5) * kMilli,
      longest.Quantile(0.99) * kMilli, errors);
}

nlohmann::ordered_json LoadReport::ToJson() const {
  return {{"decisions", decisions},
          {"decisions_per_second", DecisionsPerSecond()},
          {"p50_seconds", latency.Quantile(0.5)},
          {"p99_seconds", latency.Quantile(0.99)},
          {"longest_wait_p50_seconds", longest.Quantile(0.5)},
          {"longest_wait_p99_seconds", longest.Quantile(0.99)},
          {"errors", errors}};
}

}  // namespace spikeserve
