// What a server knows of the link to the robot that plays a session. Not part of the session's
// value: the next server learns it anew.
//
//   RobotLink link;
//   link.OnRequest(received, observed_at);  // of the server's and of the robot's clock
//   if (link.LeastAge(clock.Now(), observed_at) > budget) ...  // the observation is too old
//
// Not thread-safe: protected by the lock of its session.
#pragma once

#include <algorithm>
#include <cstdint>
#include <optional>

#include "absl/time/time.h"

namespace spikeserve {

// A robot's own counts since it began to play the session; see BeatReport in policy_service.proto.
struct BeatCounts {
  uint64_t fresh = 0;
  uint64_t held = 0;
  uint64_t local = 0;
  uint64_t safe = 0;
  uint64_t late_answers = 0;
  uint64_t cancelled_calls = 0;
  uint64_t reconnects = 0;
  uint64_t invalid_observations = 0;
  // Since the last report.
  double longest_gap_seconds = 0.0;
  double oldest_age_seconds = 0.0;

  // Returns the beats, or another count if that is greater.
  uint64_t Largest() const {
    return std::max({fresh + held + local + safe, late_answers, cancelled_calls, reconnects,
                     invalid_observations});
  }

  // Returns what was counted after `before`: 0 for a count that has become smaller.
  BeatCounts Since(const BeatCounts& before) const {
    const auto grown = [](uint64_t now, uint64_t then) { return now > then ? now - then : 0; };
    return {.fresh = grown(fresh, before.fresh),
            .held = grown(held, before.held),
            .local = grown(local, before.local),
            .safe = grown(safe, before.safe),
            .late_answers = grown(late_answers, before.late_answers),
            .cancelled_calls = grown(cancelled_calls, before.cancelled_calls),
            .reconnects = grown(reconnects, before.reconnects),
            .invalid_observations = grown(invalid_observations, before.invalid_observations),
            .longest_gap_seconds = longest_gap_seconds,
            .oldest_age_seconds = oldest_age_seconds};
  }
};

class RobotLink {
 public:
  // `period` is the time between two beats of the robot; zero: unknown.
  explicit RobotLink(absl::Duration period = absl::ZeroDuration())
      : least_period_(period > absl::ZeroDuration() ? period / 2 : kLeastPeriod) {}

  // The counts of a robot may be larger by these beats than the time since its first report allows,
  // at twice its rate. What waited in a cut link arrives at once.
  static constexpr absl::Duration kAhead = absl::Seconds(10);
  // No robot that declares no period has shorter ones.
  static constexpr absl::Duration kLeastPeriod = absl::Milliseconds(1);
  // A first report may tell of a gap before the session, in which no server was reached.
  static constexpr absl::Duration kFirstGap = absl::Minutes(10);

  // Requests of this time are compared with each other. Clocks that differ by 100 parts in a
  // million drift apart by 2 ms in two of them.
  static constexpr absl::Duration kWindow = absl::Seconds(10);

  // How long requests may be later than the measure by the same time until the robot's clock is
  // taken to have stood still. A link that was cut makes up for that time much faster: what waited
  // in it arrives at once.
  static constexpr absl::Duration kTrial = absl::Milliseconds(250);
  // Less than this is what links do.
  static constexpr absl::Duration kLate = absl::Milliseconds(100);

  // Takes a request that was received at `received`, by the server's clock, with an observation
  // that was made at `observed_at` of the robot's clock. Clocks are compared by what was measured
  // since the robot's clock has gone back, or stood still while its computer was suspended.
  void OnRequest(absl::Duration received, absl::Duration observed_at) {
    const absl::Duration offset = received - observed_at;
    if (!least_.has_value() || observed_at < newest_ - kWindow ||
        HasStoodStill(received, observed_at)) {
      least_ = before_ = offset;
      since_ = received;
      newest_ = observed_at;
    }
    if (received - since_ > kWindow) {
      before_ = *least_;
      least_ = offset;
      since_ = received;
    }
    least_ = std::min(*least_, offset);
    newest_ = std::max(newest_, observed_at);
  }

  // Returns how old the observation is at the time `now` of the server's clock, less what the
  // fastest of the last requests took from its observation to its arrival. The observation is this
  // old at least: the clocks of the robot and the server are not compared. REQUIRES: OnRequest was
  // called.
  absl::Duration LeastAge(absl::Duration now, absl::Duration observed_at) const {
    return now - observed_at - std::min(*least_, before_);
  }

  // Takes a report that was received at `received`, and returns what it adds to the last one. The
  // first report to a server that has taken the session over (`is_new_session` is false) adds
  // nothing: another server has counted it. Nullopt: more than can have happened in this time, as
  // when a robot counts what it did in an earlier session; later reports are compared with this
  // one.
  std::optional<BeatCounts> OnReport(const BeatCounts& report, bool is_new_session,
                                     absl::Duration received) {
    const BeatCounts before = report_.value_or(is_new_session ? BeatCounts() : report);
    BeatCounts added = report.Since(before);
    const absl::Duration gap = report_.has_value() ? received - reported_ + kAhead : kFirstGap;
    for (double* seconds : {&added.longest_gap_seconds, &added.oldest_age_seconds}) {
      if (*seconds > absl::ToDoubleSeconds(gap)) *seconds = 0.0;
    }
    if (!report_.has_value()) first_reported_ = received;
    report_ = report;
    reported_ = received;
    const double most = absl::FDivDuration(received - first_reported_ + kAhead, least_period_);
    if (static_cast<double>(counted_ + added.Largest()) > most) return std::nullopt;
    counted_ += added.Largest();
    beats_.fresh += added.fresh;
    beats_.held += added.held;
    beats_.local += added.local;
    beats_.safe += added.safe;
    return added;
  }

  // Returns the last report; absent: there was none.
  const std::optional<BeatCounts>& report() const { return report_; }
  // Returns the beats by source that the reports have added.
  const BeatCounts& beats() const { return beats_; }

 private:
  // Returns whether all requests of the last kTrial were later than the measure by about the same
  // time. Begins again with a request that is not, or is earlier than those before it by half of
  // the time in which they came: a queue that empties.
  bool HasStoodStill(absl::Duration received, absl::Duration observed_at) {
    const absl::Duration late = received - observed_at - std::min(*least_, before_);
    if (late < kLate) {
      trial_.reset();
      return false;
    }
    if (!trial_.has_value() || trial_->late - late > (received - trial_->begun) / 2) {
      trial_ = {.begun = received, .late = late};
    }
    if (received - trial_->begun < kTrial) return false;
    trial_.reset();
    return true;
  }

  struct Trial {
    absl::Duration begun;  // of the server's clock
    absl::Duration late;   // by the measure, of the request that began it
  };

  // Arrival minus observation of the fastest request in this window and in the window before.
  std::optional<absl::Duration> least_;
  absl::Duration before_;
  absl::Duration since_;        // begin of the window, of the server's clock
  absl::Duration newest_;       // observation, of the robot's clock
  std::optional<Trial> trial_;  // absent: the last request was not late
  std::optional<BeatCounts> report_;
  absl::Duration first_reported_;  // of the server's clock, as the next
  absl::Duration reported_;
  BeatCounts beats_;
  uint64_t counted_ = 0;  // the largest counts of all reports together
  absl::Duration least_period_;
};

}  // namespace spikeserve
