#include "spikeserve/pilot_options.h"

#include <algorithm>
#include <cmath>
#include <iostream>

#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

constexpr absl::Duration kShortestPeriod = absl::Milliseconds(1);
constexpr absl::Duration kLongestPeriod = absl::Hours(1);
// Half of a slow round trip's worth of answers is no use to a robot.
constexpr absl::Duration kLeastAge = absl::Milliseconds(250);
constexpr absl::Duration kRamp = absl::Milliseconds(200);
// A connection may have 100 calls, and one stream more than enough.
constexpr int kMostInFlight = 64;

absl::Status Refuse(absl::string_view field, absl::string_view expected, int received) {
  return absl::InvalidArgumentError(
      absl::StrCat(field, ": expected ", expected, ", received ", received));
}

absl::Status Refuse(absl::string_view field, absl::string_view expected, absl::Duration received) {
  return absl::InvalidArgumentError(
      absl::StrCat(field, ": expected ", expected, ", received ", absl::FormatDuration(received)));
}

// Returns how many periods are in `duration`, rounded up.
int Beats(absl::Duration duration, absl::Duration period) {
  return static_cast<int>(std::ceil(absl::FDivDuration(duration, period)));
}

}  // namespace

void LogPilotToStderr(absl::string_view line) { std::cerr << absl::StrCat("pilot: ", line, "\n"); }

absl::Status PilotOptions::Validate() const {
  if (period < kShortestPeriod || period > kLongestPeriod) {
    return Refuse("period", "1ms to 1h", period);
  }
  if (budget.has_value() && (*budget < absl::ZeroDuration() || *budget > period)) {
    return Refuse("budget", absl::StrCat("0 to period (", absl::FormatDuration(period), ")"),
                  *budget);
  }
  if (max_age.has_value() && *max_age <= absl::ZeroDuration()) {
    return Refuse("max_age", "more than 0", *max_age);
  }
  if (hold_beats < 0) return Refuse("hold_beats", "at least 0", hold_beats);
  if (ramp_beats.has_value() && *ramp_beats < 0) {
    return Refuse("ramp_beats", "at least 0", *ramp_beats);
  }
  if (in_flight.has_value() && (*in_flight < 1 || *in_flight > kMostInFlight)) {
    return Refuse("in_flight", absl::StrCat("1 to ", kMostInFlight), *in_flight);
  }
  if (redundancy < 1 || redundancy > 2) return Refuse("redundancy", "1 or 2", redundancy);
  if (kept_beats < 2) return Refuse("kept_beats", "at least 2", kept_beats);
  if (close_timeout < absl::ZeroDuration()) {
    return Refuse("close_timeout", "at least 0", close_timeout);
  }
  return absl::OkStatus();
}

absl::Duration PilotOptions::oldest() const {
  return max_age.value_or(std::max(kLeastAge, 3 * period));
}

int PilotOptions::ramp() const { return ramp_beats.value_or(Beats(kRamp, period)); }

size_t PilotOptions::most_in_flight() const {
  const double beats = std::ceil(absl::FDivDuration(oldest(), period)) + 1.0;
  const double usual = std::clamp(beats, 4.0, static_cast<double>(kMostInFlight));
  return static_cast<size_t>(in_flight.value_or(static_cast<int>(usual)));
}

}  // namespace spikeserve
