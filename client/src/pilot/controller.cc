#include "client/src/pilot/controller.h"

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

Pilot::Controller::Controller(Replicas* replicas, piloting::BackgroundThread* background,
                              std::shared_ptr<Route> route, v1::OpenSessionRequest opening,
                              const v1::OpenSessionResponse& opened, const ActionValue& neutral,
                              PilotOptions options)
    : options_(std::move(options)),
      route_(std::move(route)),
      shape_(opened.action_space()),
      neutral_(neutral),
      state_(static_cast<size_t>(options_.kept_beats),
             static_cast<size_t>(opened.observation_size()), shape_, neutral_, options_.hold_beats,
             options_.oldest_held(), options_.ramp()),
      link_(replicas, background, route_.get(), std::move(opening), opened, &options_, &state_),
      no_observation_(static_cast<size_t>(opened.observation_size()),
                      std::numeric_limits<float>::quiet_NaN()),
      fitted_(neutral),
      returned_(neutral) {}

PilotAction Pilot::Controller::Beat(absl::Span<const float> observation, double reward,
                                    const std::optional<ActionView>& executed) {
  const absl::Duration now = SteadyNow();
  const absl::Duration observed_at = RobotNow();
  piloting::Blindness why;
  const bool sees = piloting::IsObservation(observation, no_observation_.size(), &why);
  if (!sees && !has_seen_) return RefuseBeat(why);
  has_seen_ = true;
  const absl::string_view traceparent = Traceparent();
  {
    absl::MutexLock lock(&state_.mutex);
    TakeExecuted(executed);
    if (!sees) {
      ++state_.counters.counts().invalid_observations;
      state_.blindness = why;
      Replace(Replaced::kObservation);
    }
    const uint64_t number = state_.log.Add(sees ? observation : absl::Span<const float>(),
                                           is_new_episode_ ? 0.0 : Finite(reward),
                                           absl::ToInt64Nanoseconds(observed_at), traceparent);
    Queue(number, sees, now);
    is_new_episode_ = false;
    if (Choose(number, sees, observed_at, now + options_.wait())) return Finish();
  }
  // The robot's function may ask the pilot for its counts, so it runs without the lock.
  bool failed = false;
  const ActionView own = Fallback(sees ? observation : no_observation_, &failed);
  absl::MutexLock lock(&state_.mutex);
  if (failed) {
    ++state_.counters.counts().failures;
    state_.replaced[static_cast<size_t>(Replaced::kFallback)] = true;
  }
  state_.fallback.TakeSafe(own);
  return Finish();
}

PilotAction Pilot::Controller::RefuseBeat(const piloting::Blindness& why) {
  absl::MutexLock lock(&state_.mutex);
  state_.blindness = why;
  Replace(Replaced::kObservation);
  state_.NotifyWork();
  return {.value = neutral_.view(),
          .source = ActionSource::kSafe,
          .age = absl::ZeroDuration(),
          .beat = beats_,
          .status = absl::InvalidArgumentError(why.ToString())};
}

void Pilot::Controller::Queue(uint64_t number, bool sees, absl::Duration now) {
  const bool may_ask =
      state_.log.is_current() || (state_.ends_on_stream && state_.log.is_one_behind());
  const bool is_news = sees || (state_.log.running().steps > 1 && state_.counters.IsReportDue(now));
  const bool may_send = is_news && state_.is_connected && may_ask &&
                        state_.under_way.size() < state_.window && now >= state_.paused_until;
  if (may_send) {
    state_.queued = {.episode = state_.log.running().index,
                     .number = number,
                     .sent = now,
                     .ends = false,
                     .asks = sees};
  }
  state_.NotifyWork();
}

absl::string_view Pilot::Controller::Traceparent() const {
  if (options_.traceparent == nullptr) return "";
  try {
    return options_.traceparent();
  } catch (...) {  // of the robot's own function; a beat never throws
    return "";
  }
}

bool Pilot::Controller::Choose(uint64_t number, bool sees, absl::Duration observed_at,
                               absl::Duration deadline) {
  const bool is_fresh = sees && TakeAnswer(deadline);
  if (is_miswired_) {
    state_.fallback.Release();
    return state_.fallback.Ramp();
  }
  return is_fresh || state_.fallback.Hold(observed_at) ||
         (sees && TakeLocal(number, observed_at, deadline)) || state_.fallback.Ramp();
}

bool Pilot::Controller::HasAnswer() const {
  return state_.answer.is_there && state_.answer.number >= next_answer_;
}

std::optional<uint64_t> Pilot::Controller::ExpectedAnswer(absl::Duration deadline) const {
  const auto is_due = [&](const piloting::SentRequest& request) {
    state_.mutex.AssertHeld();
    return !state_.round_trip.has_value() || request.sent + *state_.round_trip <= deadline;
  };
  if (state_.queued.has_value() && state_.queued->asks && is_due(*state_.queued)) {
    return state_.queued->number;
  }
  for (size_t i = state_.under_way.size(); i-- > 0;) {
    const piloting::SentRequest& request = state_.under_way[i];
    if (request.episode != state_.log.running().index) return std::nullopt;
    if (request.asks && is_due(request)) return request.number;
  }
  return std::nullopt;
}

bool Pilot::Controller::TakeAnswer(absl::Duration deadline) {
  while (true) {
    const auto wanted = ExpectedAnswer(deadline);
    if (!wanted.has_value() || (HasAnswer() && state_.answer.number >= *wanted)) break;
    if (!Wait(deadline)) break;
  }
  if (!HasAnswer()) return false;
  next_answer_ = state_.answer.number + 1;
  is_miswired_ = state_.answer.is_miswired;
  if (is_miswired_) return false;
  if (RobotNow() - state_.answer.observed_at > options_.oldest()) {
    ++state_.counters.counts().stale;
    return false;
  }
  state_.fallback.TakeFresh(state_.answer.action.view(), state_.answer.observed_at);
  return true;
}

bool Pilot::Controller::TakeLocal(uint64_t number, absl::Duration observed_at,
                                  absl::Duration deadline) {
  const auto is_there = [&] {
    state_.mutex.AssertHeld();
    return state_.local.is_there && state_.local.number == number;
  };
  while (state_.has_local && !is_there()) {
    if (!Wait(deadline)) break;
  }
  if (!state_.has_local || !is_there()) return false;
  state_.fallback.TakeLocal(state_.local.action.view(), observed_at);
  return true;
}

bool Pilot::Controller::Wait(absl::Duration deadline) {
  const absl::Duration left = deadline - SteadyNow();
  if (left <= absl::ZeroDuration()) return false;
  Lockable lockable(&state_.mutex);
  state_.has_decision.wait_for(lockable, absl::ToChronoNanoseconds(left));
  return true;
}

ActionView Pilot::Controller::Fallback(absl::Span<const float> observation, bool* failed) {
  if (options_.fallback == nullptr) return neutral_.view();
  try {
    if (shape_.Fit(options_.fallback(observation), &fitted_)) return fitted_.view();
  } catch (...) {  // of the robot's own function; a beat never throws
  }
  *failed = true;
  return neutral_.view();
}

PilotAction Pilot::Controller::Finish() {
  const absl::Duration age =
      std::max(absl::ZeroDuration(), RobotNow() - state_.fallback.observed_at());
  returned_.Assign(state_.fallback.action().view());
  state_.log.SetExecuted(returned_.view());
  state_.counters.CountBeat(state_.fallback.source(), age, SteadyNow());
  return {
      .value = returned_.view(), .source = state_.fallback.source(), .age = age, .beat = beats_++};
}

std::future<Pilot::Summary> Pilot::Controller::EndEpisode(EpisodeOutcome outcome) {
  absl::MutexLock lock(&state_.mutex);
  const bool is_closed = state_.closes_at.has_value();
  const piloting::RobotEpisode& running = state_.log.running();
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
    state_.blindness = why;
    Replace(Replaced::kObservation);
    outcome.observation.clear();
  }
  auto summary = state_.log.End(std::move(outcome));
  state_.fallback.BeginEpisode();
  is_new_episode_ = true;
  next_answer_ = state_.log.next();
  state_.NotifyWork();
  return summary;
}

bool Pilot::Controller::WaitReady(absl::Duration timeout) {
  const absl::Duration deadline = SteadyNow() + timeout;
  absl::MutexLock lock(&state_.mutex);
  while (!HasAnswer()) {
    const absl::Duration now = SteadyNow();
    if (now >= deadline) return false;
    // No beat asks meanwhile: the stream may have opened, or broken, after the last one.
    const piloting::RobotEpisode& running = state_.log.running();
    if (running.steps > 0 && state_.under_way.empty() && !state_.queued.has_value()) {
      const uint64_t newest = state_.log.next() - 1;
      Queue(newest, !state_.log.At(newest).observation.empty(), now);
    }
    Wait(std::min(deadline, now + kAskAgain));
  }
  return true;
}

PilotStats Pilot::Controller::Stats() const {
  absl::MutexLock lock(&state_.mutex);
  PilotStats stats = state_.counters.Snapshot();
  if (state_.blindness.expected > 0) {
    stats.last_invalid_observation = state_.blindness.ToString();
  }
  stats.entries = state_.fallback.entries();
  stats.dropped = state_.log.dropped();
  stats.lost_episodes = state_.log.lost_episodes();
  stats.has_local = state_.has_local;
  stats.local_head_is_copy = state_.has_local && state_.shares_head;
  return stats;
}

std::string Pilot::Controller::session_id() const {
  absl::MutexLock lock(&state_.mutex);
  return state_.session_id;
}

double Pilot::Controller::Finite(double reward) {
  if (std::isfinite(reward)) return reward;
  Replace(Replaced::kReward);
  return 0.0;
}

void Pilot::Controller::TakeExecuted(const std::optional<ActionView>& executed) {
  if (!executed.has_value() || is_new_episode_) return;
  if (!shape_.Fit(*executed, &fitted_)) {
    Replace(Replaced::kExecuted);
    return;
  }
  state_.fallback.SetExecuted(fitted_.view());
  state_.log.SetExecuted(fitted_.view());
}

void Pilot::Controller::Replace(Replaced kind) {
  ++state_.counters.counts().invalid;
  state_.replaced[static_cast<size_t>(kind)] = true;
}

}  // namespace spikeserve
