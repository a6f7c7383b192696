#include "core/agent/beats.h"

#include <algorithm>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/agent/repeated_step.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "core/session/session_value.h"

namespace spikeserve {
namespace {

std::string Name(size_t i) { return absl::StrCat("history[", i, "]"); }

// Returns the step of the first beat of the history.
int64_t FirstStep(const BeatHistory& history) {
  return history.step - static_cast<int64_t>(history.size);
}

// Checks what does not depend on the session.
absl::Status CheckForm(const BeatHistory& history) {
  const auto skipped = static_cast<int64_t>(history.skipped_rewards.size());
  if (history.size == 0) {
    return absl::InvalidArgumentError(
        absl::StrCat("history: expected at least one beat behind skipped_rewards, received none"));
  }
  if (skipped > kMostSkippedRewards) {
    return absl::InvalidArgumentError(absl::StrCat("skipped_rewards: expected at most ",
                                                   kMostSkippedRewards, ", received ", skipped));
  }
  if (FirstStep(history) < skipped) {
    return absl::InvalidArgumentError(absl::StrCat(
        "history: expected at most ", history.step, " beats and skipped_rewards before step ",
        history.step, ", received ", static_cast<int64_t>(history.size) + skipped));
  }
  if (!history.decision.has_value()) {
    return absl::InvalidArgumentError(
        "decision: expected the number of the decision, because the request has history, received "
        "none");
  }
  return absl::OkStatus();
}

// Checks that the history reaches back to the next step of the session, in the same episode.
absl::Status CheckPlace(const BeatHistory& history, const Session& session) {
  const auto steps = static_cast<uint64_t>(history.step - session.step);
  if (*history.decision != session.decisions + steps) {
    return absl::FailedPreconditionError(
        absl::StrCat("decision: expected ", session.decisions, " for step ", session.step,
                     ", received ", *history.decision, " for step ", history.step));
  }
  const int64_t first = FirstStep(history) - static_cast<int64_t>(history.skipped_rewards.size());
  // A store may have lost what was executed before the first beat, which nothing else tells then.
  const bool may_lack_action = session.step > 0 && FirstStep(history) == session.step &&
                               session.options.durability != Durability::kNone;
  if (first <= session.step && !may_lack_action) return absl::OkStatus();
  const int64_t latest = may_lack_action ? session.step - 1 : session.step;
  return absl::FailedPreconditionError(
      absl::StrCat("history: expected beats from step ", latest, " on, received those from step ",
                   may_lack_action ? FirstStep(history) : first, " on"));
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
absl::Status CheckBeats(const BeatHistory& history, const AgentSession& agent) {
  const Policy& policy = agent.policy();
  const Session& session = agent.session();
  const int64_t first = FirstStep(history);
  ReturnToGo return_to_go(session);
  const auto skipped = static_cast<int64_t>(history.skipped_rewards.size());
  for (int64_t i = std::max<int64_t>(0, session.step - (first - skipped)); i < skipped; ++i) {
    auto status = return_to_go.Take(history.skipped_rewards[static_cast<size_t>(i)]);
    if (!status.ok()) return Annotate(status, absl::StrCat("skipped_rewards[", i, "]"));
  }
  // The executed action of the last beat that the session has is new, too. The beats that its own
  // history has are compared.
  std::optional<ReportedAction> executed;  // at the step before
  const auto known = std::max<int64_t>(1, static_cast<int64_t>(session.history.size()));
  for (int64_t i = std::max<int64_t>(0, session.step - known - first);
       i < static_cast<int64_t>(history.size); ++i) {
    const auto index = static_cast<size_t>(i);
    const Beat beat = history.beat(index);
    absl::Status status;
    if (beat.step != first + i) {
      status = absl::InvalidArgumentError(
          absl::StrCat("step: expected ", first + i, ", received ", beat.step));
    }
    if (status.ok()) status = ParseExecutedAction(beat.executed, policy.action_space).status();
    if (status.ok() && beat.step >= session.step) {
      if (!beat.observation.empty()) {
        status = CheckObservation(beat.observation, policy.observation_size());
      }
      if (status.ok()) status = return_to_go.Take(beat.reward);
    }
    if (status.ok() && beat.step < session.step) {
      status = CheckRepeatedStep({.step = beat.step,
                                  .observation = beat.observation,
                                  .reward = beat.reward,
                                  .executed = std::exchange(executed, beat.executed)},
                                 policy.action_space, session);
    }
    if (!status.ok()) return Annotate(status, Name(index));
  }
  if (history.end_reward.has_value()) return return_to_go.Take(*history.end_reward);
  if (history.observation.empty()) return absl::OkStatus();
  if (auto status = CheckObservation(history.observation, policy.observation_size());
      !status.ok()) {
    return status;
  }
  return return_to_go.Take(history.reward);
}

// Returns whether the reward of `beat` was left out where one is expected.
bool LacksReward(const Beat& beat) { return beat.step > 0 && !beat.has_reward; }

// Returns how many of the beats from `begin` to before `end` lack their reward.
int64_t MissingRewards(const BeatHistory& history, int64_t begin, int64_t end) {
  int64_t missing = 0;
  for (int64_t step = std::max(begin, FirstStep(history)); step < end; ++step) {
    missing += LacksReward(history.beat(static_cast<size_t>(step - FirstStep(history)))) ? 1 : 0;
  }
  return missing;
}

// Counts the rewards of the steps before `end` that the session does not have.
int64_t Skip(const BeatHistory& history, int64_t end, AgentSession* agent) {
  const int64_t first = FirstStep(history);
  const auto skipped = static_cast<int64_t>(history.skipped_rewards.size());
  std::vector<double> rewards;
  for (int64_t step = agent->session().step; step < end; ++step) {
    rewards.push_back(step < first
                          ? history.skipped_rewards[static_cast<size_t>(step - first + skipped)]
                          : history.beat(static_cast<size_t>(step - first)).reward);
  }
  if (!rewards.empty()) agent->SkipSteps(rewards);
  return static_cast<int64_t>(rewards.size());
}

// Returns the rewards of the beats from `index` on that have no observation, up to the first that
// has one.
std::vector<double> BlindRewards(const BeatHistory& history, size_t index) {
  std::vector<double> rewards;
  for (; index < history.size; ++index) {
    const Beat beat = history.beat(index);
    if (!beat.observation.empty()) break;
    rewards.push_back(beat.reward);
  }
  return rewards;
}

// Returns the step behind the last beat that is taken.
int64_t PastOf(const BeatHistory& history) {
  if (!history.observation.empty() || history.end_reward.has_value()) return history.step;
  size_t size = history.size;
  while (size > 0 && history.beat(size - 1).observation.empty()) --size;
  return FirstStep(history) + static_cast<int64_t>(size);
}

// Skips the beats without an observation, whose `rewards` are given, from `index` on. Before them,
// takes the executed action of the beat that they follow.
absl::Status SkipBlind(const BeatHistory& history, size_t index, absl::Span<const double> rewards,
                       AgentSession* agent) {
  if (index > 0 && !agent->session().history.empty() &&
      !history.beat(index - 1).observation.empty()) {
    ASSIGN_OR_RETURN(const Action executed, ParseExecutedAction(history.beat(index - 1).executed,
                                                                agent->policy().action_space));
    agent->ReportExecuted(executed);
  }
  agent->SkipSteps(rewards);
  return absl::OkStatus();
}

}  // namespace

absl::StatusOr<AppendedBeats> AppendBeats(const BeatHistory& history, AgentSession* agent,
                                          int64_t most,
                                          absl::FunctionRef<void(const Beat&)> on_appended) {
  SPIKESERVE_DCHECK_GE(most, 1);
  RETURN_IF_ERROR(CheckForm(history));
  AppendedBeats result;
  const Session& session = agent->session();
  if (history.step < session.step) return result;
  RETURN_IF_ERROR(CheckPlace(history, session));
  if (!history.is_checked) RETURN_IF_ERROR(CheckBeats(history, *agent));
  agent->ExpectExecutedActions();
  const int64_t first = FirstStep(history);
  const int64_t past = PastOf(history);
  if (past <= std::max(first, session.step)) return result;
  const int64_t begun = session.step;
  result.dropped =
      Skip(history, std::min(std::max(first, history.step - kHistoryLimit), past - 1), agent);
  bool after_gap = result.dropped > 0;
  while (session.step < past) {
    if (result.appended == most) {
      result.finished = false;
      break;
    }
    auto index = static_cast<size_t>(session.step - first);
    if (const auto blind = BlindRewards(history, index); !blind.empty()) {
      RETURN_IF_ERROR(SkipBlind(history, index, blind, agent));
      result.dropped += static_cast<int64_t>(blind.size());
      index += blind.size();
      if (index == history.size) break;
      after_gap = true;
    }
    const Beat beat = history.beat(index);
    std::optional<ReportedAction> executed;
    if (index > 0 && !after_gap) executed = history.beat(index - 1).executed;
    after_gap = false;
    if (auto status = agent->Append(beat.observation, beat.reward, executed); !status.ok()) {
      return Annotate(status, Name(index));
    }
    ++result.appended;
    on_appended(beat);
  }
  result.missing_rewards = MissingRewards(history, begun, session.step);
  return result;
}

absl::Status TakeLastExecuted(const BeatHistory& history, AgentSession* agent) {
  if (history.size == 0 || history.step == 0 || history.step != agent->session().step) {
    return absl::OkStatus();
  }
  const Beat last = history.beat(history.size - 1);
  if (last.observation.empty()) return absl::OkStatus();  // skipped: nothing was decided there
  const auto executed = ParseExecutedAction(last.executed, agent->policy().action_space);
  if (!executed.ok()) return Annotate(executed.status(), Name(history.size - 1));
  agent->ReportExecuted(*executed);
  return absl::OkStatus();
}

}  // namespace spikeserve
