// Applies a robot's requests to its session, without any network code.
//
//   AgentSession agent(served, NewSession(id, options), clock);
//   absl::StatusOr<const Answer*> answer = agent.Act(/*step=*/0, observation, /*reward=*/0.0);
//   agent.AppendPendingAction();  // after the answer was sent
//
// Not thread-safe: one caller at a time.
#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <utility>
#include <vector>

#include "Eigen/Core"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "absl/types/span.h"
#include "core/agent/operator_seat.h"
#include "core/agent/served_policy.h"
#include "core/agent/session_head.h"
#include "core/agent/session_life.h"
#include "core/agent/session_listener.h"
#include "core/agent/step.h"
#include "core/agent/wiring_check.h"
#include "core/base/clock.h"
#include "core/engine/engine.h"
#include "core/session/session.h"

namespace spikeserve {

// One agent's session on one policy version.
class AgentSession {
 public:
  // Continues `session`, which is new or restored. Creates its learner if it learns and has none.
  // `clock` measures `compute_seconds` and must outlive this object. REQUIRES: `session` was opened
  // on this policy, or restored from a session that was.
  AgentSession(std::shared_ptr<const ServedPolicy> served, Session session, const Clock* clock);

  // Does what the requests of different sessions ask for, in three passes: adds the steps that a
  // session does not have, ends episodes, and decides. The results are equal, bit for bit, to those
  // of one call per step. Sessions of one policy version load its weights once; the time of their
  // common work is divided evenly between the `compute_seconds` of their answers. Histories are
  // taken as far as `budget` goes, which is reduced; null: to their ends. A step whose result is
  // not finished is applied again, with its result, before other requests of its session.
  //
  // Sets the result of each step. Errors do not change the session; past steps before the one that
  // fails are kept:
  // - INVALID_ARGUMENT, which names the field: a history that is not well-formed, a vector of the
  //   wrong length, a number that is not finite, an executed action outside the action space;
  // - FAILED_PRECONDITION: another place in the session, a history that does not reach back to the
  //   step that the session expects, another content of a step that it has (repeated_step.h), an
  //   end without a decision since the last one. The first past step for a stored session is not
  //   the one that it expects: its server may have lost what was executed before it;
  // - UNAVAILABLE: an end, while the fleet's head has not taken the contribution of the episode
  //   before yet;
  // - INTERNAL, which names the policy: its answer is not finite.
  //
  // The step that was answered last, with the same content, is a retry: it returns the stored
  // answer, and nothing is counted twice. So is an end before the next decision and, if it names
  // its decision, later.
  //
  // `executed` takes the place of the last answer in the history, in learning and in recordings. An
  // action without a source was chosen by what chose the answer, if it equals that.
  // Rewards and executed actions are ignored at step 0. A past step without an observation counts
  // as a reward: the context begins again behind it. At the end of a history, such steps wait until
  // an observation or the end follows.
  static void Apply(absl::Span<Step* const> steps, StepBudget* budget = nullptr);

  // As Apply, for one step that is decided; absent: the next one.
  absl::StatusOr<const Answer*> Act(std::optional<int64_t> step,
                                    absl::Span<const float> observation, double reward,
                                    const std::optional<ReportedAction>& executed = std::nullopt);
  // As Apply, for the end of the running episode.
  absl::StatusOr<EpisodeSummary> EndEpisode(
      const EpisodeEnd& end, const std::optional<ReportedAction>& executed = std::nullopt);
  // Takes the next step, which has no observation: counts its reward when a step with one, or the
  // end of the episode, is applied without a place. For players that decide step by step.
  absl::Status AddBlindStep(double reward, const std::optional<ReportedAction>& executed);
  // Returns the next step, behind those without an observation.
  int64_t next_step() const { return session_.step + static_cast<int64_t>(blind_rewards_.size()); }

  // Gives an episode that waits for its verdict the amended rewards, and learns from it. Returns
  // what became of it, at once for the same amendment again. Errors do not change the session, but
  // for episodes whose time is over, which are learned from first:
  // - ALREADY_EXISTS: the episode has another amendment of this id;
  // - FAILED_PRECONDITION: the time of the episode is over;
  // - NOT_FOUND: the episode does not wait;
  // - INVALID_ARGUMENT: as many rewards as the episode has no steps;
  // - UNAVAILABLE: as for Apply.
  // REQUIRES: the rewards and their sum are finite.
  absl::StatusOr<Verdict> Amend(const Amendment& amendment);
  // Learns from episodes that wait and whose time is over. Returns whether others wait, or the head
  // of the fleet has not taken the last one yet.
  bool Settle();
  // A verdict has changed the return of an episode that has been learned from, or is not.
  void OnAmended(int64_t episode, double change) {
    life_.OnAmended(change, episode + 1 == session_.episode && session_.step == 0);
  }

  // Returns the error with which Apply would refuse `step` as a new decision, or OK.
  absl::Status CheckNewDecision(Step& step) const;

  // Appends the last action to the engine's context, after the answer was sent: this keeps the work
  // out of the latency of the next one. Does nothing once the agent has reported an executed
  // action.
  void AppendPendingAction();
  // As above, for different sessions together.
  static void AppendPendingActions(absl::Span<AgentSession* const> sessions);

  // Replaces the last action in the history only: not in the stored answer, which retries return.
  // REQUIRES: the last call was Act.
  void OverrideLastAction(const Action& action) { session_.history.ReplaceLastAction(action); }

  // Returns the contribution whose outcome the last returned summary may lack; null: it lacks none.
  const std::shared_ptr<FleetContribution>& contribution() const { return head_.contribution(); }
  // Returns how many episodes have contributed to the head of a fleet in this process.
  int64_t contributions() const { return head_.contributions(); }
  // Calls `listener` for the decisions and episodes after this call.
  void AddListener(std::shared_ptr<SessionListener> listener);

  void DropContext() { context_.Drop(); }  // the next decision makes it again
  // Frees all memory that the session's value does not need. For sessions that have been idle.
  void Compact();

  const Session& session() const { return session_; }
  const Policy& policy() const { return served_->policy(); }
  // Returns a summary of what the session has done since this object was created.
  const SessionLife& life() const { return life_; }
  // Returns how much speaks for a person's help.
  Help NeedsHelp() const;
  // Returns whether the last answer has the neutral action, because of the verdict about the
  // wiring.
  bool acts_safely() const {
    return session_.last_answer.has_value() &&
           session_.last_answer->source.kind == SourceKind::kSafetyLayer;
  }

  // Holds the session from its next decision on; null: does not. Nothing of an episode that is held
  // is learned.
  void SetHold(std::shared_ptr<const Hold> hold) {
    if (hold == nullptr || hold_ == nullptr || *hold != *hold_) is_at_neutral_ = false;
    hold_ = std::move(hold);
  }
  const std::shared_ptr<const Hold>& hold() const { return hold_; }
  // Returns whether a request has shown that the robot took the neutral action under the hold.
  bool is_at_neutral() const { return is_at_neutral_; }

  // Returns the operator who acts in the policy's place, or null.
  const Seat* seat() const { return seat_.IsOver(session_) ? nullptr : &*session_.seat; }
  // As the methods of OperatorSeat. TakeControl and ReturnControl report the change.
  absl::Status TakeControl(const Seat& seat, bool takes_over);
  absl::Status Steer(absl::string_view lease_id, const Action* action) {
    return seat_.Steer(lease_id, action, &session_);
  }
  absl::Status ReturnControl(absl::string_view lease_id);
  // As Learner::UndoCorrections, of the last `ago`; nullopt, too, if the head is not private.
  std::optional<int64_t> UndoCorrections(absl::string_view operator_id, absl::Duration ago);
  // Returns when this object was created, of the clock. Not guarded by the lock of the session.
  absl::Duration created() const { return created_; }
  absl::Duration Age() const { return clock_->Now() - created_; }
  // Returns W - W_base of the head that the next decision uses, [act * d], row-major; empty if
  // it is the policy's head.
  Eigen::VectorXf HeadDelta() const { return head_.Delta(session_); }
  // Returns |W - W_base| / |W_base| of that head.
  double HeadDrift() const { return head_.Drift(session_); }
  // Returns how often a guard or an operator rolled back the head that this session learns.
  int64_t Rollbacks() const { return head_.Rollbacks(session_); }

 private:
  struct HistoryPass;
  struct DecisionPass;
  struct EndPass;

  // What the engine keeps of the session's tokens: a cache, which is made again from the history
  // before a decision if it is absent. Answers do not depend on whether it was.
  struct Context {
    // The last action in the history was replaced by an executed one.
    void OnExecuted() {
      if (!lacks_action) engine.reset();  // it holds the answered action
      expects_executed = true;
    }
    void Drop() {
      engine.reset();
      lacks_action = false;
    }

    std::unique_ptr<Engine::Context> engine = nullptr;  // null: absent
    bool lacks_action = false;                          // the last one in the history
    // The agent reports executed actions: the next request may replace the last action, which is
    // therefore appended by that request.
    bool expects_executed = false;
  };

  // Puts the action that `source` chose in the place of the last answer. A decision, the end of the
  // episode or OnChange() follows.
  void TakeExecuted(const Action& executed, const ReportedSource& source);
  // Puts the action in the place of the last answer, without a further decision. REQUIRES: the
  // running episode has a decision.
  absl::Status ReportExecuted(const ReportedAction& reported);
  // Counts the rewards of the next steps, whose observations are not known. REQUIRES: a decision or
  // the end of the episode follows; if it fails, the steps are not counted either.
  void SkipSteps(absl::Span<const double> rewards);
  // Notes who chose the action of the step before, whose place in the history is final.
  void CountSource(const StepSource& source);
  // Undoes SkipSteps, if no decision has followed.
  void RestoreSkipped() {
    if (before_skipped_ != nullptr) session_ = *std::exchange(before_skipped_, nullptr);
  }
  using EndReport = bool (SessionListener::*)(const Session&,
                                              const std::shared_ptr<FleetContribution>&);
  // Reports an episode that has ended, or its verdict, to the listeners, and hands over what it
  // contributes. `episode_return`, if it is final, enters the figures.
  void Report(EndReport report, std::optional<double> episode_return, double target_return);
  // Learns from episodes that wait and whose time is over.
  void LearnOverdue();
  // Learns from an episode that waits. REQUIRES: no contribution is on its way.
  void Judge(const WaitingEpisode& ended, std::vector<double> rewards, Verdict verdict);
  // Counts rewards that were left out after step 0, and are 0.
  void CountMissingRewards(int64_t rewards) {
    life_.OnMissingRewards(rewards);
    served_->observer->OnMissingRewards(rewards);
  }
  // Counts an answer that holds NaN or infinity, and returns its error.
  absl::Status NonFiniteError() const;

  std::shared_ptr<const ServedPolicy> served_;
  const Clock* clock_;
  Session session_;
  absl::Duration created_;  // time of the clock
  SessionLife life_;
  Context context_;
  SessionHead head_;
  WiringResponse wiring_response_;
  OperatorSeat seat_;
  std::shared_ptr<const Hold> hold_;  // null: none
  bool is_at_neutral_ = false;
  // The session before steps that were skipped, until the next decision; null: none were.
  std::unique_ptr<const Session> before_skipped_;
  std::vector<double> blind_rewards_;  // of AddBlindStep, which no step has counted yet
  std::vector<std::shared_ptr<SessionListener>> listeners_;
};

}  // namespace spikeserve
