// Counts what a pilot does, in bounded memory.
//
// Not thread-safe.
#ifndef CLIENT_SRC_PILOT_COUNTERS_H_
#define CLIENT_SRC_PILOT_COUNTERS_H_

#include <array>
#include <cstddef>
#include <cstdint>

#include "absl/time/time.h"
#include "spikeserve/pilot_stats.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve::piloting {

// Ages in buckets that grow by 2 %, from 10 us to more than an hour.
class Ages {
 public:
  void Add(absl::Duration age);
  // Returns the age that `share` of the ages do not exceed; 0: there are none.
  absl::Duration Quantile(double share) const;

 private:
  std::array<uint64_t, 1000> counts_ = {};
  uint64_t total_ = 0;
};

class Counters {
 public:
  explicit Counters(absl::Duration now) : fresh_at_(now) {}

  // The counts that have no method of their own.
  PilotStats& counts() { return counts_; }

  // Counts a beat, at the time `now`.
  void CountBeat(ActionSource source, absl::Duration age, absl::Duration now);
  bool IsReportDue(absl::Duration now) const;
  // Fills the report that is due, about once a second. Returns false if none is.
  bool FillReport(absl::Duration now, v1::BeatReport* report);
  // Returns the counts with the figures that are computed from all beats.
  PilotStats Snapshot() const;

 private:
  PilotStats counts_;
  Ages ages_;
  absl::Duration fresh_at_;      // time of the last fresh action
  absl::Duration reported_gap_;  // the longest since the last report
  absl::Duration oldest_age_;    // since the last report
  absl::Duration reported_at_ = -absl::InfiniteDuration();
};

}  // namespace spikeserve::piloting

#endif  // CLIENT_SRC_PILOT_COUNTERS_H_
