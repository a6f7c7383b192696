// The part of RobotSession that runs with each control step. It allocates no memory.
#include <algorithm>
#include <cmath>
#include <utility>

#include "core/robot/robot_session.h"

namespace spikeserve::robot {

bool RobotSession::BeginStep(const StepInput& input, Now now) {
  InvalidObservation why;
  sees_ = IsObservation(input.observation, settings_.observation_size, &why);
  if (!sees_) {
    invalid_ = why;
    Note(kObservation);
    if (!is_proven_) return false;
    ++counters_.counts().invalid_observations;
  }
  is_proven_ = true;
  TakeExecuted(input.executed, input.chooser);
  const double reward = log_.next() == began_ ? 0.0 : Finite(input.reward);
  observed_at_ = now.robot;
  step_ = log_.Add(sees_ ? input.observation : std::span<const float>(), reward, observed_at_,
                   input.traceparent);
  Queue(step_, sees_, now.steady);
  return true;
}

void RobotSession::Queue(uint64_t number, bool sees, Time now) {
  const bool may_ask = log_.is_current() || (log_.is_one_behind() && EndsOnStream());
  // A step without an observation asks for nothing: it only reports, and brings what was before.
  const bool is_news = sees || (log_.running().steps > 1 && counters_.IsReportDue(now));
  while (!datagrams_.empty() && now - datagrams_.front().sent > settings_.oldest) datagrams_.Pop();
  transport_.Check(datagrams_, now);
  const Ways ways = OpenWays(now);
  if ((ways.stream || ways.datagram) && is_news && may_ask && now >= paused_until_) {
    queued_ = {.episode = log_.running().index, .number = number, .sent = now, .asks = sees};
  }
}

void RobotSession::AskAgain(Now now) {
  if (log_.running().steps == 0 || !in_flight_.empty() || queued_.has_value()) return;
  if (!datagrams_.empty()) {  // the answer may come, unless the datagram is lost
    const Time sent = datagrams_[datagrams_.size() - 1].sent;
    const bool is_lost = transport_.IsLate(sent, now.steady);
    if (!is_lost && now.steady - sent < settings_.oldest) return;
  }
  const uint64_t newest = log_.next() - 1;
  Queue(newest, !log_.At(newest).observation.empty(), now.steady);
}

Choice RobotSession::Choose(Now now, Time deadline) {
  const bool may_wait = now.steady < deadline;
  if (sees_) {
    if (may_wait && AwaitsAnswer(now.steady, deadline)) return Choice::kWait;
    if (TakeAnswer(now)) return Choice::kTaken;
  }
  if (stays_safe_) {
    fallback_.Release();
    return fallback_.Ramp() ? Choice::kTaken : Choice::kOwnAction;
  }
  if (fallback_.Hold(observed_at_)) return Choice::kTaken;
  if (sees_ && local_.is_ready()) {
    if (decided_here_.step == step_) {
      fallback_.TakeLocal(decided_here_.action.view(), observed_at_);
      return Choice::kTaken;
    }
    if (may_wait) return Choice::kWait;
  }
  return fallback_.Ramp() ? Choice::kTaken : Choice::kOwnAction;
}

// Returns whether a newer answer than what is here should arrive before the deadline.
bool RobotSession::AwaitsAnswer(Time now, Time deadline) const {
  const std::optional<uint64_t> wanted = ExpectedAnswer(now, deadline);
  return wanted.has_value() && !(HasAnswer() && *answer_.step >= *wanted);
}

// Returns the newest step whose answer should arrive before `deadline`; nothing: none should. A
// stream brings what is late, and a datagram that is late was lost.
std::optional<uint64_t> RobotSession::ExpectedAnswer(Time now, Time deadline) const {
  const auto is_due = [&](const SentRequest& request) {
    return request.asks && request.sent + round_trip_.value_or(Time::zero()) <= deadline;
  };
  if (queued_.has_value() && is_due(*queued_)) return queued_->number;
  std::optional<uint64_t> newest;
  for (const InFlight* way : {&in_flight_, &datagrams_}) {
    for (size_t i = way->size(); i-- > 0 && (*way)[i].episode == log_.running().index;) {
      if (!is_due((*way)[i])) continue;
      if (way == &datagrams_ && transport_.IsLate((*way)[i].sent, now)) break;
      newest = std::max(newest, std::optional((*way)[i].number));
      break;
    }
  }
  return newest;
}

// A channel belongs to the session, not to the stream: datagrams go on while that is opened again.
// What they overtake, they have in their history; but not the end of an episode, with which and
// behind which requests go both ways until it is answered.
Ways RobotSession::OpenWays(Time now) const {
  const bool is_open = link_ == LinkState::kOnline && in_flight_.size() < window_;
  if (!has_session() || !log_.FitsDatagram()) return {.stream = is_open};
  const Ways wanted = transport_.Choose(now);
  const bool is_wanted = wanted.datagram || (!is_open && transport_.is_offered(now));
  const bool is_end = log_.is_ending() || !log_.is_current();
  return {.stream = (wanted.stream || is_end) && is_open,
          .datagram = is_wanted && datagrams_.size() < window_};
}

bool RobotSession::TakeAnswer(Now now) {
  if (!HasAnswer()) return false;
  next_answer_ = *answer_.step + 1;
  if (now.robot - answer_.observed_at > settings_.oldest) {
    ++counters_.counts().stale;
    return false;
  }
  fallback_.TakeFresh(answer_.action.view(), answer_.observed_at, answer_.chooser.view());
  return true;
}

void RobotSession::TakeOwn(const ActionView* action) {
  const bool is_valid = action != nullptr && log_.shape().Fit(*action, &fitted_);
  if (!is_valid) {
    ++counters_.counts().failures;
    Note(kFallback);
  }
  fallback_.TakeSafe(is_valid ? fitted_.view() : settings_.neutral.view());
}

StepResult RobotSession::FinishStep(Now now) {
  const Time age = std::max(Time::zero(), now.robot - fallback_.observed_at());
  log_.SetExecuted(fallback_.action().view(), fallback_.chooser());
  counters_.CountStep(fallback_.source(), age, now.steady);
  return {.action = fallback_.action().view(),
          .chooser = fallback_.chooser(),
          .source = fallback_.source(),
          .age = age};
}

std::optional<uint64_t> RobotSession::EndEpisode(Outcome outcome, const ActionView* executed,
                                                 const ChooserView& chooser) {
  if (log_.running().steps == 0 || is_closing()) return std::nullopt;
  TakeExecuted(executed, chooser);
  outcome.reward = Finite(outcome.reward);
  if (outcome.target_return.has_value() && !std::isfinite(*outcome.target_return)) {
    Note(kReward);
    outcome.target_return.reset();
  }
  InvalidObservation why;
  if (!outcome.observation.empty() &&
      !IsObservation(outcome.observation, settings_.observation_size, &why)) {
    invalid_ = why;
    Note(kObservation);
    outcome.observation.clear();
  }
  const uint64_t serial = log_.End(std::move(outcome));
  fallback_.BeginEpisode();
  queued_.reset();  // the history of the end brings the step
  began_ = next_answer_ = log_.next();
  return serial;
}

// Replace what is not valid, which is counted, and logged once.
double RobotSession::Finite(double reward) {
  if (std::isfinite(reward)) return reward;
  Note(kReward);
  return 0.0;
}

void RobotSession::TakeExecuted(const ActionView* executed, const ChooserView& chooser) {
  if (log_.next() == began_ || (executed == nullptr && chooser.kind == Chooser::kUnknown)) return;
  const ActionView chosen = log_.At(log_.next() - 1).executed;
  if (!log_.shape().Fit(executed == nullptr ? chosen : *executed, &fitted_)) return Note(kExecuted);
  if (chooser.kind == Chooser::kUnknown && IsEqual(chosen, fitted_.view())) return;
  if (!IsValid(chooser)) Note(kExecuted);
  fallback_.SetExecuted(fitted_.view());
  log_.SetExecuted(fitted_.view(), Fit(chooser));
}

void RobotSession::Note(Notice kind) {
  if (kind != kFallback) ++counters_.counts().invalid;
  if (notices_[kind] == Logged::kNone) notices_[kind] = Logged::kDue;
}

}  // namespace spikeserve::robot
