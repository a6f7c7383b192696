// The three passes of AgentSession::Apply(). Private to the session.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/types/span.h"
#include "core/action/action_head.h"
#include "core/agent/agent_session.h"
#include "core/agent/step.h"
#include "core/engine/engine.h"

namespace spikeserve {

// Adds the past steps that the session does not have. Each is added as the decision that the policy
// would have made there, in whose place the executed action then is. The session is therefore
// equal, bit for bit, to one that was asked for every step and told the executed actions.
struct AgentSession::HistoryPass {
  // Takes the times of the step, and the next part of its history as far as `budget` goes, which it
  // reduces. Returns whether the decision is to be made now; false: it is not yet, or not at all.
  static absl::StatusOr<bool> Take(Step& step, StepBudget* budget);

 private:
  struct Part;

  static absl::Status TakeParts(Step& step, bool decides, StepBudget* budget);
  // Adds at most `most` past steps.
  static absl::StatusOr<Part> TakePart(Step& step, bool decides, int64_t most);
  // Adds the past step `index` as a decision.
  static absl::Status Append(const Step& step, size_t index);
  // Counts the rewards of the steps before `end` that the session does not have, and returns their
  // number.
  static int64_t SkipUntil(const Step& step, int64_t end);
  // Counts the rewards of the past steps from `index` on that have no observation, and returns
  // their number. Before them, takes the executed action of the step that they follow.
  static absl::StatusOr<int64_t> SkipBlind(const Step& step, size_t index);
  // Puts the executed action of the past step `index` in the place of the last answer.
  static absl::Status TakeExecuted(const Step& step, size_t index);
};

// Decides.
struct AgentSession::DecisionPass {
  // Returns whether `step` requires a new decision. Otherwise sets its result.
  static bool IsNew(Step& step);
  // Decides new decisions of different sessions. Changes their order.
  static void Decide(std::vector<Step*>& steps);
  // As Decide, for sessions of one policy version.
  static void DecideVersion(absl::Span<Step* const> steps);
  // As AppendPendingActions, but also for agents that report executed actions.
  static void AppendActions(absl::Span<AgentSession* const> sessions);
  // Notes whether the robot took its neutral action under the hold. `executed`: in the place of the
  // last answer, as a decision or an end reports it; absent: as answered.
  static void ConfirmNeutral(const Step& step, const std::optional<Action>& executed);

 private:
  // Returns the answer that `choice` gives, without what only the session or the caller knows.
  // Leaves in `choice` what the answer does not store.
  static Answer MakeAnswer(AgentSession& agent, const Engine::Output& output, double reward,
                           ActionChoice* choice);
  // Compares the observation of the next step with the wiring of the training data.
  static void CheckWiring(AgentSession& agent, absl::Span<const float> observation);
  // Adds the answer to the session, and reports it.
  static void Record(Step& step, Answer answer, absl::Span<const float> readout,
                     absl::Span<const float> noise);
  // Replaces the action of the last answer by that of a hold, of an operator, or the neutral one
  // because of the wiring, in this order. Returns whether a journal's entry would not tell all of
  // what has changed.
  static bool Overrule(AgentSession& agent, bool is_past);
};

// Ends the episode, or repeats the summary of the last one.
struct AgentSession::EndPass {
  static void Take(Step& step, StepBudget* budget);

 private:
  static absl::Status TakeUnlessRefused(Step& step, StepBudget* budget);
  // Checks what does not depend on the session, and takes the executed action into the end.
  static absl::Status CheckValues(Step& step);
  // Ends an episode that has a decision.
  static absl::StatusOr<EpisodeSummary> End(const Step& step);
  // Returns the stored summary.
  static absl::StatusOr<EpisodeSummary> Repeat(const EpisodeEnd& end, AgentSession& agent);
};

}  // namespace spikeserve
