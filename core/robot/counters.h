// Counts what a robot does, in bounded memory.
//
// Not thread-safe.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string_view>

#include "core/robot/time.h"

namespace spikeserve::robot {

// Who chose an action, in the order of the fallback.
enum class Source { kFresh, kHeld, kLocal, kSafe };
inline constexpr size_t kSources = 4;
using BySource = std::array<uint64_t, kSources>;

// Returns "fresh", "held", "local" or "safe".
std::string_view SourceName(Source source);

// Counts since the robot began; spikeserve::PilotStats says what each one is.
struct Counts {
  uint64_t steps = 0;
  BySource by_source = {};
  uint64_t stale = 0;
  uint64_t late_answers = 0;
  uint64_t cancelled_requests = 0;
  uint64_t datagram_answers = 0;
  uint64_t reconnects = 0;
  uint64_t reopened = 0;
  uint64_t unequal_returns = 0;
  uint64_t invalid = 0;
  uint64_t invalid_observations = 0;
  uint64_t failures = 0;
  Time longest_gap = Time::zero();  // without a fresh action
};

// What a request reports to the server: the counts, and the worst since the last report.
struct Report {
  const Counts* counts;
  Time longest_gap;
  Time oldest_age;
};

// Ages in buckets that grow by 2 %, from 10 us to more than an hour.
class Ages {
 public:
  static constexpr size_t kBuckets = 1000;

  void Add(Time age);
  // Returns the age that `share` of the ages do not exceed; 0: there are none.
  Time Quantile(double share) const;

 private:
  std::array<uint64_t, kBuckets> counts_ = {};
  uint64_t total_ = 0;
};

class Counters {
 public:
  explicit Counters(Time now) : fresh_at_(now) {}

  Counts& counts() { return counts_; }
  const Counts& counts() const { return counts_; }
  const Ages& ages() const { return ages_; }  // of all actions but the safe ones

  // Counts a control step, at the time `now`.
  void CountStep(Source source, Time age, Time now);
  bool IsReportDue(Time now) const;
  // Returns the report that is due, about once a second.
  std::optional<Report> TakeReport(Time now);

 private:
  Counts counts_;
  Ages ages_;
  Time fresh_at_;                     // time of the last fresh action
  Time reported_gap_ = Time::zero();  // the longest since the last report
  Time oldest_age_ = Time::zero();    // since the last report
  Time reported_at_ = kLongAgo;
};

}  // namespace spikeserve::robot
