#include "client/src/pilot/cockpit.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <utility>

#include "client/src/lockable.h"
#include "client/src/steady_time.h"

namespace spikeserve {

using piloting::ActionValue;
using piloting::LostEpisode;
using piloting::Replaced;

namespace {

constexpr absl::Duration kAskAgain = absl::Milliseconds(50);

}  // namespace

Pilot::Cockpit::Cockpit(Replicas* replicas, piloting::Crew* crew, std::shared_ptr<Route> route,
                        v1::OpenSessionRequest opening, const v1::OpenSessionResponse& opened,
                        const ActionValue& neutral, PilotOptions options)
    : options_(std::move(options)),
      route_(std::move(route)),
      shape_(opened.action_space()),
      neutral_(neutral),
      facts_(static_cast<size_t>(options_.kept_beats),
             static_cast<size_t>(opened.observation_size()), shape_, neutral_, options_.hold_beats,
             options_.oldest_held(), options_.ramp()),
      link_(replicas, crew, route_.get(), std::move(opening), opened, &options_, &facts_),
      no_observation_(static_cast<size_t>(opened.observation_size()),
                      std::numeric_limits<float>::quiet_NaN()),
      fitted_(neutral),
      returned_(neutral) {}

PilotAction Pilot::Cockpit::Beat(absl::Span<const float> observation, double reward,
                                 const std::optional<ActionView>& executed) {
  const absl::Duration now = SteadyNow();
  const absl::Duration observed_at = RobotNow();
  piloting::Blindness why;
  const bool sees = piloting::IsObservation(observation, no_observation_.size(), &why);
  if (!sees && !has_seen_) return RefuseBeat(why);
  has_seen_ = true;
  const absl::string_view traceparent = Traceparent();
  {
    absl::MutexLock lock(&facts_.mutex);
    TakeExecuted(executed);
    if (!sees) {
      ++facts_.counters.counts().invalid_observations;
      facts_.blindness = why;
      Replace(Replaced::kObservation);
    }
    const uint64_t number = facts_.log.Add(sees ? observation : absl::Span<const float>(),
                                           is_new_episode_ ? 0.0 : Finite(reward),
                                           absl::ToInt64Nanoseconds(observed_at), traceparent);
    Queue(number, sees, now);
    is_new_episode_ = false;
    if (Choose(number, sees, observed_at, now + options_.wait())) return Finish();
  }
  // The robot's function may ask the pilot for its counts, so it runs without the lock.
  bool failed = false;
  const ActionView own = Fallback(sees ? observation : no_observation_, &failed);
  absl::MutexLock lock(&facts_.mutex);
  if (failed) {
    ++facts_.counters.counts().failures;
    facts_.replaced[static_cast<size_t>(Replaced::kFallback)] = true;
  }
  facts_.ladder.TakeSafe(own);
  return Finish();
}

PilotAction Pilot::Cockpit::RefuseBeat(const piloting::Blindness& why) {
  absl::MutexLock lock(&facts_.mutex);
  facts_.blindness = why;
  Replace(Replaced::kObservation);
  facts_.NotifyWork();
  return {.value = neutral_.view(),
          .source = ActionSource::kSafe,
          .age = absl::ZeroDuration(),
          .beat = beats_,
          .status = absl::InvalidArgumentError(why.ToString())};
}

void Pilot::Cockpit::Queue(uint64_t number, bool sees, absl::Duration now) {
  const bool may_ask =
      facts_.log.is_current() || (facts_.ends_on_stream && facts_.log.is_one_behind());
  const bool is_news = sees || (facts_.log.running().steps > 1 && facts_.counters.IsReportDue(now));
  const bool may_send = is_news && facts_.is_connected && may_ask &&
                        facts_.under_way.size() < facts_.window && now >= facts_.paused_until;
  if (may_send) {
    facts_.queued = {.episode = facts_.log.running().index,
                     .number = number,
                     .sent = now,
                     .ends = false,
                     .asks = sees};
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

bool Pilot::Cockpit::Choose(uint64_t number, bool sees, absl::Duration observed_at,
                            absl::Duration deadline) {
  const bool is_fresh = sees && TakeAnswer(deadline);
  if (is_miswired_) {
    facts_.ladder.Release();
    return facts_.ladder.Ramp();
  }
  return is_fresh || facts_.ladder.Hold(observed_at) ||
         (sees && TakeLocal(number, observed_at, deadline)) || facts_.ladder.Ramp();
}

bool Pilot::Cockpit::HasAnswer() const {
  return facts_.answer.is_there && facts_.answer.number >= next_answer_;
}

std::optional<uint64_t> Pilot::Cockpit::ExpectedAnswer(absl::Duration deadline) const {
  const auto is_due = [&](const piloting::SentRequest& request) {
    facts_.mutex.AssertHeld();
    return !facts_.round_trip.has_value() || request.sent + *facts_.round_trip <= deadline;
  };
  if (facts_.queued.has_value() && facts_.queued->asks && is_due(*facts_.queued)) {
    return facts_.queued->number;
  }
  for (size_t i = facts_.under_way.size(); i-- > 0;) {
    const piloting::SentRequest& request = facts_.under_way[i];
    if (request.episode != facts_.log.running().index) return std::nullopt;
    if (request.asks && is_due(request)) return request.number;
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
  is_miswired_ = facts_.answer.is_miswired;
  if (is_miswired_) return false;
  if (RobotNow() - facts_.answer.observed_at > options_.oldest()) {
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

ActionView Pilot::Cockpit::Fallback(absl::Span<const float> observation, bool* failed) {
  if (options_.fallback == nullptr) return neutral_.view();
  try {
    if (shape_.Fit(options_.fallback(observation), &fitted_)) return fitted_.view();
  } catch (...) {  // of the robot's own function; a beat never throws
  }
  *failed = true;
  return neutral_.view();
}

PilotAction Pilot::Cockpit::Finish() {
  const absl::Duration age =
      std::max(absl::ZeroDuration(), RobotNow() - facts_.ladder.observed_at());
  returned_.Assign(facts_.ladder.action().view());
  facts_.log.SetExecuted(returned_.view());
  facts_.counters.CountBeat(facts_.ladder.source(), age, SteadyNow());
  return {
      .value = returned_.view(), .source = facts_.ladder.source(), .age = age, .beat = beats_++};
}

std::future<Pilot::Summary> Pilot::Cockpit::EndEpisode(EpisodeOutcome outcome) {
  absl::MutexLock lock(&facts_.mutex);
  const bool is_closed = facts_.closes_at.has_value();
  const piloting::RobotEpisode& running = facts_.log.running();
  if (running.steps == 0 || is_closed) {
    std::promise<Summary> known;
    v1::EndEpisodeResponse empty;
    empty.set_lost_steps(static_cast<int64_t>(running.lost_steps));
    known.set_value(running.steps == 0 ? Summary(std::move(empty))
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
  piloting::Blindness why;
  if (!outcome.observation.empty() &&
      !piloting::IsObservation(outcome.observation, no_observation_.size(), &why)) {
    facts_.blindness = why;
    Replace(Replaced::kObservation);
    outcome.observation.clear();
  }
  auto summary = facts_.log.End(std::move(outcome));
  facts_.ladder.BeginEpisode();
  is_new_episode_ = true;
  next_answer_ = facts_.log.next();
  facts_.NotifyWork();
  return summary;
}

bool Pilot::Cockpit::WaitReady(absl::Duration timeout) {
  const absl::Duration deadline = SteadyNow() + timeout;
  absl::MutexLock lock(&facts_.mutex);
  while (!HasAnswer()) {
    const absl::Duration now = SteadyNow();
    if (now >= deadline) return false;
    // No beat asks meanwhile: the stream may have opened, or broken, after the last one.
    const piloting::RobotEpisode& running = facts_.log.running();
    if (running.steps > 0 && facts_.under_way.empty() && !facts_.queued.has_value()) {
      const uint64_t newest = facts_.log.next() - 1;
      Queue(newest, !facts_.log.At(newest).observation.empty(), now);
    }
    Wait(std::min(deadline, now + kAskAgain));
  }
  return true;
}

PilotStats Pilot::Cockpit::Stats() const {
  absl::MutexLock lock(&facts_.mutex);
  PilotStats stats = facts_.counters.Snapshot();
  if (facts_.blindness.expected > 0) {
    stats.last_invalid_observation = facts_.blindness.ToString();
  }
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
