#include "client/src/pilot/cockpit.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <utility>

#include "client/src/lockable.h"
#include "client/src/steady_time.h"

namespace spikeserve {

using piloting::ActionValue;
using piloting::LostEpisode;
using piloting::Replaced;

Pilot::Cockpit::Cockpit(Replicas* replicas, piloting::Crew* crew, std::shared_ptr<Route> route,
                        v1::OpenSessionRequest opening, const v1::OpenSessionResponse& opened,
                        const ActionValue& neutral, PilotOptions options)
    : options_(std::move(options)),
      route_(std::move(route)),
      shape_(opened.action_space()),
      neutral_(neutral),
      facts_(static_cast<size_t>(options_.kept_beats),
             static_cast<size_t>(opened.observation_size()), shape_, neutral_, options_.hold_beats,
             options_.ramp(), SteadyNow()),
      link_(replicas, crew, route_.get(), std::move(opening), opened, &options_, &facts_),
      observation_(static_cast<size_t>(opened.observation_size())),
      fitted_(neutral),
      returned_(neutral) {}

PilotAction Pilot::Cockpit::Beat(absl::Span<const float> observation, double reward,
                                 const std::optional<ActionView>& executed) {
  const absl::Duration now = SteadyNow();
  const absl::string_view traceparent = Traceparent();
  {
    absl::MutexLock lock(&facts_.mutex);
    TakeExecuted(executed);
    TakeObservation(observation);
    const uint64_t number = facts_.log.Add(observation_, is_new_episode_ ? 0.0 : Finite(reward),
                                           absl::ToInt64Nanoseconds(now), traceparent);
    Queue(number, now);
    is_new_episode_ = false;
    if (Choose(number, now, now + options_.wait())) return Finish();
  }
  // The robot's function may ask the pilot for its counts, so it runs without the lock.
  bool failed = false;
  const ActionView own = Fallback(&failed);
  absl::MutexLock lock(&facts_.mutex);
  if (failed) {
    ++facts_.counters.counts().failures;
    facts_.replaced[static_cast<size_t>(Replaced::kFallback)] = true;
  }
  facts_.ladder.TakeSafe(own);
  return Finish();
}

void Pilot::Cockpit::Queue(uint64_t number, absl::Duration now) {
  const bool may_ask =
      facts_.log.is_current() || (facts_.ends_on_stream && facts_.log.is_one_behind());
  const bool may_send = facts_.is_connected && may_ask && facts_.under_way.size() < facts_.window &&
                        now >= facts_.paused_until;
  if (may_send) {
    facts_.queued = {.episode = facts_.log.running().index, .number = number, .sent = now};
  }
  facts_.NotifyWork();
}

absl::string_view Pilot::Cockpit::Traceparent() const {
  if (options_.traceparent == nullptr) return "";
  try {
    return options_.traceparent();
  } catch (...) {  // of the robot's own function; a beat never throws
    return "";
  }
}

bool Pilot::Cockpit::Choose(uint64_t number, absl::Duration observed_at, absl::Duration deadline) {
  return TakeAnswer(deadline) || facts_.ladder.Hold() || TakeLocal(number, observed_at, deadline) ||
         facts_.ladder.Ramp();
}

bool Pilot::Cockpit::HasAnswer() const {
  return facts_.answer.is_there && facts_.answer.number >= next_answer_;
}

std::optional<uint64_t> Pilot::Cockpit::ExpectedAnswer(absl::Duration deadline) const {
  const auto is_due = [&](const piloting::SentRequest& request) {
    facts_.mutex.AssertHeld();
    return !facts_.round_trip.has_value() || request.sent + *facts_.round_trip <= deadline;
  };
  if (facts_.queued.has_value() && is_due(*facts_.queued)) return facts_.queued->number;
  for (size_t i = facts_.under_way.size(); i-- > 0;) {
    const piloting::SentRequest& request = facts_.under_way[i];
    if (request.episode != facts_.log.running().index) return std::nullopt;
    if (is_due(request)) return request.number;
  }
  return std::nullopt;
}

bool Pilot::Cockpit::TakeAnswer(absl::Duration deadline) {
  while (true) {
    const auto wanted = ExpectedAnswer(deadline);
    if (!wanted.has_value() || (HasAnswer() && facts_.answer.number >= *wanted)) break;
    if (!Wait(deadline)) break;
  }
  if (!HasAnswer()) return false;
  next_answer_ = facts_.answer.number + 1;
  if (SteadyNow() - facts_.answer.observed_at > options_.oldest()) {
    ++facts_.counters.counts().stale;
    return false;
  }
  facts_.ladder.TakeFresh(facts_.answer.action.view(), facts_.answer.observed_at);
  return true;
}

bool Pilot::Cockpit::TakeLocal(uint64_t number, absl::Duration observed_at,
                               absl::Duration deadline) {
  const auto is_there = [&] {
    facts_.mutex.AssertHeld();
    return facts_.local.is_there && facts_.local.number == number;
  };
  while (facts_.has_local && !is_there()) {
    if (!Wait(deadline)) break;
  }
  if (!facts_.has_local || !is_there()) return false;
  facts_.ladder.TakeLocal(facts_.local.action.view(), observed_at);
  return true;
}

bool Pilot::Cockpit::Wait(absl::Duration deadline) {
  const absl::Duration left = deadline - SteadyNow();
  if (left <= absl::ZeroDuration()) return false;
  Lockable lockable(&facts_.mutex);
  facts_.has_decision.wait_for(lockable, absl::ToChronoNanoseconds(left));
  return true;
}

ActionView Pilot::Cockpit::Fallback(bool* failed) {
  if (options_.fallback == nullptr) return neutral_.view();
  try {
    if (shape_.Fit(options_.fallback(observation_), &fitted_)) return fitted_.view();
  } catch (...) {  // of the robot's own function; a beat never throws
  }
  *failed = true;
  return neutral_.view();
}

PilotAction Pilot::Cockpit::Finish() {
  const absl::Duration now = SteadyNow();
  const absl::Duration age = std::max(absl::ZeroDuration(), now - facts_.ladder.observed_at());
  returned_.Assign(facts_.ladder.action().view());
  facts_.log.SetExecuted(returned_.view());
  facts_.counters.CountBeat(facts_.ladder.source(), age, now);
  return {
      .value = returned_.view(), .source = facts_.ladder.source(), .age = age, .beat = beats_++};
}

std::future<Pilot::Summary> Pilot::Cockpit::EndEpisode(EpisodeOutcome outcome) {
  absl::MutexLock lock(&facts_.mutex);
  const bool is_closed = facts_.closes_at.has_value();
  if (is_new_episode_ || is_closed) {
    std::promise<Summary> known;
    known.set_value(is_new_episode_ ? Summary(v1::EndEpisodeResponse())
                                    : Summary(LostEpisode("the pilot was closed")));
    return known.get_future();
  }
  if (outcome.executed_action.has_value()) {
    TakeExecuted(piloting::ViewOf(*outcome.executed_action));
  }
  outcome.reward = Finite(outcome.reward);
  if (outcome.target_return.has_value() && !std::isfinite(*outcome.target_return)) {
    Replace(Replaced::kReward);
    outcome.target_return.reset();
  }
  if (!outcome.observation.empty()) {
    TakeObservation(outcome.observation);
    outcome.observation = observation_;
  }
  auto summary = facts_.log.End(std::move(outcome));
  facts_.ladder.BeginEpisode();
  is_new_episode_ = true;
  next_answer_ = facts_.log.next();
  facts_.NotifyWork();
  return summary;
}

PilotStats Pilot::Cockpit::Stats() const {
  absl::MutexLock lock(&facts_.mutex);
  PilotStats stats = facts_.counters.Snapshot();
  stats.entries = facts_.ladder.entries();
  stats.dropped = facts_.log.dropped();
  stats.lost_episodes = facts_.log.lost_episodes();
  stats.has_local = facts_.has_local;
  stats.local_head_is_copy = facts_.has_local && facts_.shares_head;
  return stats;
}

std::string Pilot::Cockpit::session_id() const {
  absl::MutexLock lock(&facts_.mutex);
  return facts_.session_id;
}

void Pilot::Cockpit::TakeObservation(absl::Span<const float> observation) {
  const bool is_valid =
      observation.size() == observation_.size() &&
      std::all_of(observation.begin(), observation.end(), [](float x) { return std::isfinite(x); });
  if (is_valid) {
    std::copy(observation.begin(), observation.end(), observation_.begin());
  } else {
    Replace(Replaced::kObservation);
  }
}

double Pilot::Cockpit::Finite(double reward) {
  if (std::isfinite(reward)) return reward;
  Replace(Replaced::kReward);
  return 0.0;
}

void Pilot::Cockpit::TakeExecuted(const std::optional<ActionView>& executed) {
  if (!executed.has_value() || is_new_episode_) return;
  if (!shape_.Fit(*executed, &fitted_)) {
    Replace(Replaced::kExecuted);
    return;
  }
  facts_.ladder.SetExecuted(fitted_.view());
  facts_.log.SetExecuted(fitted_.view());
}

void Pilot::Cockpit::Replace(Replaced kind) {
  ++facts_.counters.counts().invalid;
  facts_.replaced[static_cast<size_t>(kind)] = true;
}

}  // namespace spikeserve
