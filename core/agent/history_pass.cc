#include <algorithm>
#include <limits>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/agent/repeated_step.h"
#include "core/agent/session_passes.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "core/session/session_value.h"

namespace spikeserve {
namespace {

// How many past steps are added between two looks at the clock.
constexpr int64_t kStepsPerLook = 4;
// So many steps are checked, or skipped, in less time than one past step takes.
constexpr int64_t kChecks = 128;

// What no robot reports: a kilohertz for 30 years, and a gap of four months.
constexpr uint64_t kMostBeats = 1'000'000'000'000;
constexpr double kLongestGapSeconds = 1e7;

absl::Status CheckReport(const BeatCounts& report) {
  const std::pair<const char*, uint64_t> counts[] = {
      {"fresh", report.fresh},
      {"held", report.held},
      {"local", report.local},
      {"safe", report.safe},
      {"late_answers", report.late_answers},
      {"cancelled_calls", report.cancelled_calls},
      {"reconnects", report.reconnects},
      {"invalid_observations", report.invalid_observations}};
  for (const auto& [name, count] : counts) {
    if (count > kMostBeats) {
      return InvalidArgument(absl::StrCat("report.", name), absl::StrCat("at most ", kMostBeats),
                             count);
    }
  }
  const std::pair<const char*, double> times[] = {
      {"longest_gap_seconds", report.longest_gap_seconds},
      {"oldest_age_seconds", report.oldest_age_seconds}};
  for (const auto& [name, seconds] : times) {
    if (!(seconds >= 0.0 && seconds <= kLongestGapSeconds)) {  // true for NaN
      return InvalidArgument(absl::StrCat("report.", name),
                             absl::StrCat("0 to ", kLongestGapSeconds), seconds);
    }
  }
  return absl::OkStatus();
}

// Notes the times and the report of a request. Returns the errors of the times.
absl::Status TakeTimes(const StepTimes& times, SessionObserver& observer, SessionLife* life) {
  if (times.valid_until.has_value() && !times.observed_at.has_value()) {
    return InvalidArgument("observed_at", "a time, because the request has valid_until", "none");
  }
  if (times.observed_at.has_value() && *times.observed_at < absl::ZeroDuration()) {
    return InvalidArgument("observed_at", "at least 0",
                           absl::ToInt64Nanoseconds(*times.observed_at));
  }
  if (times.report.has_value()) {
    RETURN_IF_ERROR(CheckReport(*times.report));
  }
  if (times.observed_at.has_value()) times.link->OnRequest(times.received, *times.observed_at);
  if (times.report.has_value()) {
    const auto added = times.link->OnReport(*times.report, times.is_new_session, times.received);
    if (added.has_value()) {
      observer.OnReport(*added);
      life->help().OnReport(*added);
    } else {
      observer.OnImplausible();
    }
  }
  return absl::OkStatus();
}

bool IsExpired(const Step& step, absl::Duration now) {
  if (!step.times.has_value() || !step.times->valid_until.has_value()) return false;
  const absl::Duration observed_at = *step.times->observed_at;
  return step.times->link->LeastAge(now, observed_at) > *step.times->valid_until - observed_at;
}

std::string Name(size_t i) { return absl::StrCat("history[", i, "]"); }

// Returns the step of the first element of the history.
int64_t FirstStep(const Step& step) {
  return *step.place.step - static_cast<int64_t>(step.history.size);
}

// Checks what does not depend on the session.
absl::Status CheckForm(const Step& step) {
  const auto skipped = static_cast<int64_t>(step.skipped_rewards.size());
  if (step.history.size == 0) {
    return InvalidArgument("history", "at least one beat behind skipped_rewards", "none");
  }
  if (skipped > kMostSkippedRewards) {
    return InvalidArgument("skipped_rewards", absl::StrCat("at most ", kMostSkippedRewards),
                           skipped);
  }
  if (*step.place.step < static_cast<int64_t>(step.history.size) + skipped) {
    return InvalidArgument(
        "history",
        absl::StrCat("at most ", *step.place.step, " beats and skipped_rewards before step ",
                     *step.place.step),
        static_cast<int64_t>(step.history.size) + skipped);
  }
  if (!step.place.decision.has_value()) {
    return InvalidArgument("decision",
                           "the number of the decision, because the request has history", "none");
  }
  return absl::OkStatus();
}

// Checks that the history reaches back to the next step of the session, in the same episode.
absl::Status CheckPlace(const Step& step, const Session& session) {
  const auto steps = static_cast<uint64_t>(*step.place.step - session.step);
  if (*step.place.decision != session.decisions + steps) {
    return absl::FailedPreconditionError(
        absl::StrCat("decision: expected ", session.decisions, " for step ", session.step,
                     ", received ", *step.place.decision, " for step ", *step.place.step));
  }
  const int64_t first = FirstStep(step) - static_cast<int64_t>(step.skipped_rewards.size());
  // A store may have lost what was executed before the first beat, which nothing else tells then.
  const bool may_lack_action = session.step > 0 && FirstStep(step) == session.step &&
                               session.options.durability != Durability::kNone;
  if (first <= session.step && !may_lack_action) return absl::OkStatus();
  const int64_t latest = may_lack_action ? session.step - 1 : session.step;
  return absl::FailedPreconditionError(
      absl::StrCat("history: expected beats from step ", latest, " on, received those from step ",
                   may_lack_action ? FirstStep(step) : first, " on"));
}

// Follows the return-to-go over rewards.
class ReturnToGo {
 public:
  explicit ReturnToGo(const Session& session)
      : step_(session.step), at_start_(session.target_return), value_(session.return_to_go) {}

  // Checks the reward of the next step, which is not counted at step 0.
  absl::Status Take(double reward) {
    if (step_++ == 0) {
      value_ = at_start_;
      return absl::OkStatus();
    }
    value_ -= reward;
    return CheckReward(reward, value_);
  }

 private:
  int64_t step_;
  double at_start_;
  double value_;
};

// Checks everything that is new to the session.
absl::Status CheckPast(const Step& step, bool decides) {
  const Policy& policy = step.session->policy();
  const Session& session = step.session->session();
  const int64_t first = FirstStep(step);
  ReturnToGo return_to_go(session);
  const auto skipped = static_cast<int64_t>(step.skipped_rewards.size());
  for (int64_t i = std::max<int64_t>(0, session.step - (first - skipped)); i < skipped; ++i) {
    auto status = return_to_go.Take(step.skipped_rewards[static_cast<size_t>(i)]);
    if (!status.ok()) return Annotate(status, absl::StrCat("skipped_rewards[", i, "]"));
  }
  // The executed action of the last beat that the session has is new, too. The beats that its own
  // history has are compared.
  std::optional<ReportedAction> executed;  // at the step before
  const auto known = std::max<int64_t>(1, static_cast<int64_t>(session.history.size()));
  for (int64_t i = std::max<int64_t>(0, session.step - known - first);
       i < static_cast<int64_t>(step.history.size); ++i) {
    const auto index = static_cast<size_t>(i);
    const PastStep past = step.history[index];
    absl::Status status;
    if (past.step != first + i) {
      status = InvalidArgument("step", first + i, past.step);
    }
    if (status.ok()) status = ParseExecutedAction(past.executed, policy.action_space).status();
    if (status.ok() && past.step >= session.step) {
      if (!past.observation.empty()) {
        status = CheckObservation(past.observation, policy.observation_size());
      }
      if (status.ok()) status = return_to_go.Take(past.reward);
    }
    if (status.ok() && past.step < session.step) {
      status = CheckRepeatedStep({.session = step.session,
                                  .place = {.step = past.step},
                                  .observation = past.observation,
                                  .reward = past.reward,
                                  .executed = std::exchange(executed, past.executed)});
    }
    if (!status.ok()) return Annotate(status, Name(index));
  }
  if (step.end.has_value()) return return_to_go.Take(step.end->reward);
  if (!decides) return absl::OkStatus();
  if (auto status = CheckObservation(step.observation, policy.observation_size()); !status.ok()) {
    return status;
  }
  return return_to_go.Take(step.reward);
}

// Returns how many of the past steps from `begin` to before `end` lack their reward.
int64_t MissingRewards(const Step& step, int64_t begin, int64_t end) {
  const int64_t first = FirstStep(step);
  int64_t missing = 0;
  for (int64_t at = std::max({begin, first, int64_t{1}}); at < end; ++at) {
    missing += step.history[static_cast<size_t>(at - first)].has_reward ? 0 : 1;
  }
  return missing;
}

// Returns the step behind the last past step that is taken: steps without an observation at the end
// of the history wait until a decision or the end follows, because a session is never left without
// a context.
int64_t EndOfPast(const Step& step, bool decides) {
  if (decides || step.end.has_value()) return *step.place.step;
  size_t size = step.history.size;
  while (size > 0 && step.history[size - 1].observation.empty()) --size;
  return FirstStep(step) + static_cast<int64_t>(size);
}

}  // namespace

// What one part of a history has added.
struct AgentSession::HistoryPass::Part {
  int64_t appended = 0;         // with their observations
  int64_t dropped = 0;          // as rewards only, with or without an observation
  int64_t missing_rewards = 0;  // of these, after step 0
  bool finished = true;         // false: more past steps are to be added
};

absl::StatusOr<bool> AgentSession::HistoryPass::Take(Step& step, StepBudget* budget) {
  AgentSession& agent = *step.session;
  StepOutcome& result = step.result;
  if (!step.place.step.has_value()) {
    if (!agent.blind_rewards_.empty()) agent.SkipSteps(agent.blind_rewards_);
    return true;
  }
  if (!step.times.has_value() && !step.has_past()) return true;
  const Clock& clock = *agent.clock_;
  SessionObserver& observer = *agent.served_->observer;
  const absl::Duration start = clock.Now();
  result.begun = start;
  if (step.times.has_value() && !result.started) {
    if (auto status = TakeTimes(*step.times, observer, &agent.life_); !status.ok()) return status;
  }
  result.started = true;
  // A request for an answer that was given is answered.
  const auto expire = [&](bool is_late) {
    result.expired = is_late && *step.place.step >= agent.session_.step;
    if (result.expired) observer.OnExpired();
    return !result.expired;
  };
  if (!step.has_past()) return expire(IsExpired(step, start));
  const bool asks = !step.observation.empty();
  const bool is_late = asks && IsExpired(step, start);
  const absl::Status taken = TakeParts(step, asks && !is_late, budget);
  if (!taken.ok()) return taken;
  result.begun = clock.Now();
  result.spent += result.begun - start;
  if (!result.finished) return false;
  if (expire(is_late) && asks) return true;
  if (*step.place.step < agent.session_.step) return false;  // asks again for no answer
  RETURN_IF_ERROR(TakeExecuted(step, step.history.size - 1));
  return false;
}

absl::Status AgentSession::HistoryPass::TakeParts(Step& step, bool decides, StepBudget* budget) {
  AgentSession& agent = *step.session;
  StepOutcome& result = step.result;
  result.finished = false;
  if (!result.checked && budget->steps > 0) {
    const auto checks = static_cast<int64_t>(step.history.size + step.skipped_rewards.size());
    budget->steps = std::max<int64_t>(1, budget->steps - checks / kChecks);
  }
  while (!result.finished && budget->steps > 0) {
    const auto part = TakePart(step, decides, std::min(budget->steps, kStepsPerLook));
    --budget->steps;  // also for what is refused
    if (!part.ok()) return part.status();
    budget->steps -= std::max<int64_t>(0, part->appended - 1) + part->dropped / kChecks;
    result.checked = true;
    result.appended += part->appended;
    result.dropped += part->dropped;
    if (part->missing_rewards > 0) agent.CountMissingRewards(part->missing_rewards);
    if (part->dropped > 0) agent.served_->observer->OnSkippedBeats(part->dropped);
    result.finished = part->finished;
    if (agent.clock_->Now() >= budget->until) budget->steps = 0;
  }
  return absl::OkStatus();
}

absl::StatusOr<AgentSession::HistoryPass::Part> AgentSession::HistoryPass::TakePart(Step& step,
                                                                                    bool decides,
                                                                                    int64_t most) {
  SPIKESERVE_DCHECK_GE(most, 1);
  AgentSession& agent = *step.session;
  const Session& session = agent.session_;
  RETURN_IF_ERROR(CheckForm(step));
  Part part;
  if (*step.place.step < session.step) return part;
  RETURN_IF_ERROR(CheckPlace(step, session));
  if (!step.result.checked) RETURN_IF_ERROR(CheckPast(step, decides));
  agent.context_.expects_executed = true;
  const int64_t first = FirstStep(step);
  const int64_t end = EndOfPast(step, decides);
  if (end <= std::max(first, session.step)) return part;
  const int64_t begun = session.step;
  part.dropped =
      SkipUntil(step, std::min(std::max(first, *step.place.step - kHistoryLimit), end - 1));
  while (session.step < end) {
    if (part.appended == most) {
      part.finished = false;
      break;
    }
    ASSIGN_OR_RETURN(const int64_t blind,
                     SkipBlind(step, static_cast<size_t>(session.step - first)));
    part.dropped += blind;
    if (session.step == *step.place.step) break;
    RETURN_IF_ERROR(Append(step, static_cast<size_t>(session.step - first)));
    ++part.appended;
  }
  part.missing_rewards = MissingRewards(step, begun, session.step);
  return part;
}

absl::Status AgentSession::HistoryPass::Append(const Step& step, size_t index) {
  const PastStep past = step.history[index];
  Step taken = {.session = step.session,
                .observation = past.observation,
                .reward = past.reward,
                .is_past = true};
  taken.result.checked = true;
  if (index > 0) taken.executed = step.history[index - 1].executed;
  if (DecisionPass::IsNew(taken)) {
    DecisionPass::DecideVersion({&taken});
  }
  return Annotate(taken.result.status, Name(index));
}

int64_t AgentSession::HistoryPass::SkipUntil(const Step& step, int64_t end) {
  const int64_t first = FirstStep(step);
  const auto skipped = static_cast<int64_t>(step.skipped_rewards.size());
  std::vector<double> rewards;
  for (int64_t at = step.session->session_.step; at < end; ++at) {
    rewards.push_back(at < first ? step.skipped_rewards[static_cast<size_t>(at - first + skipped)]
                                 : step.history[static_cast<size_t>(at - first)].reward);
  }
  if (!rewards.empty()) step.session->SkipSteps(rewards);
  return static_cast<int64_t>(rewards.size());
}

absl::StatusOr<int64_t> AgentSession::HistoryPass::SkipBlind(const Step& step, size_t index) {
  std::vector<double> rewards;
  for (size_t i = index; i < step.history.size; ++i) {
    const PastStep past = step.history[i];
    if (!past.observation.empty()) break;
    rewards.push_back(past.reward);
  }
  if (rewards.empty()) return 0;
  if (index > 0 && !step.session->session_.history.empty()) {
    RETURN_IF_ERROR(TakeExecuted(step, index - 1));
  }
  step.session->SkipSteps(rewards);
  return static_cast<int64_t>(rewards.size());
}

absl::Status AgentSession::HistoryPass::TakeExecuted(const Step& step, size_t index) {
  const PastStep past = step.history[index];
  if (past.observation.empty()) return absl::OkStatus();  // skipped: nothing was decided there
  return Annotate(step.session->ReportExecuted(past.executed), Name(index));
}

void AgentSession::SkipSteps(absl::Span<const double> rewards) {
  head_.TakeMerged(&session_);
  if (before_skipped_ == nullptr) before_skipped_ = std::make_unique<const Session>(session_);
  for (const double reward : rewards) CountSkipped(reward, &session_);
  session_.history.Clear();
  DropContext();
  for (const auto& listener : listeners_) listener->OnGap();
}

absl::Status AgentSession::ReportExecuted(const ReportedAction& reported) {
  ASSIGN_OR_RETURN(const Action executed, ParseExecutedAction(reported, policy().action_space));
  const bool is_known = executed == session_.history.action(session_.history.size() - 1);
  const StepSource before = session_.executed_source;
  TakeExecuted(executed, reported.source);
  if (is_known && session_.executed_source == before) return absl::OkStatus();
  for (const auto& listener : listeners_) listener->OnChange(session_);
  return absl::OkStatus();
}

}  // namespace spikeserve
