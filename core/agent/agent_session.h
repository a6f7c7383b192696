// Applies an agent's requests to its session, without any network code.
//
//   AgentSession agent(served, NewSession(id, options), clock);
//   absl::StatusOr<const Answer*> answer = agent.Act(/*step=*/0, observation, /*reward=*/0.0);
//   agent.AppendPendingAction();  // after the answer was sent
//
// Not thread-safe: one caller at a time.
#ifndef CORE_AGENT_AGENT_SESSION_H_
#define CORE_AGENT_AGENT_SESSION_H_

#include <cstdint>
#include <memory>
#include <optional>
#include <vector>

#include "Eigen/Core"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "absl/types/span.h"
#include "core/agent/act_call.h"
#include "core/agent/context_cache.h"
#include "core/agent/served_policy.h"
#include "core/agent/session_head.h"
#include "core/agent/session_life.h"
#include "core/agent/session_listener.h"
#include "core/agent/wiring_check.h"
#include "core/base/clock.h"
#include "core/session/session.h"

namespace spikeserve {

// One agent's session on one policy version.
class AgentSession {
 public:
  // Continues `session`, which is new or restored. Creates its learner if it learns and has none.
  // `clock` measures `compute_seconds` and must outlive this object. REQUIRES: `session` was opened
  // on this policy, or restored from a session that was.
  AgentSession(std::shared_ptr<const ServedPolicy> served, Session session, const Clock* clock);

  // Decides timestep `step` from `observation` [obs], in environment units, and from `reward`,
  // which the previous action earned. `executed` is the action that was executed at the previous
  // step, if it differs from the answered one; it takes the answer's place in the history, in
  // learning and in recordings. Both are ignored at step 0. The returned answer is valid until the
  // next call that changes the session.
  //
  // The step that was answered last, with the same arguments, is a retry: it returns the stored
  // answer, and nothing is counted twice. Errors do not change the session: FAILED_PRECONDITION for
  // another step, or other arguments (repeated_step.h); INVALID_ARGUMENT for an observation of the
  // wrong length, a number that is not finite or an executed action outside the action space;
  // INTERNAL, which names the policy, if the policy's answer is not finite.
  absl::StatusOr<const Answer*> Act(int64_t step, absl::Span<const float> observation,
                                    double reward,
                                    const std::optional<ReportedAction>& executed = std::nullopt);
  // Appends the last action to the engine's context, after the answer was sent: this keeps the work
  // out of the latency of the next one. Does nothing once the agent has reported an executed
  // action.
  void AppendPendingAction();

  // As Act and AppendPendingAction, for several different sessions, with results that are equal bit
  // for bit. Sessions of one policy version load its weights once. The time of their common work is
  // divided evenly between the `compute_seconds` of their answers.
  static void ActTogether(absl::Span<ActCall> calls);
  static void AppendPendingActions(absl::Span<AgentSession* const> sessions);
  // Returns the error with which ActTogether would refuse `call` as a new decision, or OK.
  absl::Status CheckNewDecision(const ActCall& call) const;

  // The next four methods add what the agent did without the server; beats.h checks and calls them.
  // Adds the next step as Act decides it, but counts no decision for the observer.
  absl::Status Append(absl::Span<const float> observation, double reward,
                      const std::optional<ReportedAction>& executed);
  // Counts the rewards of the next steps, whose observations are not known. REQUIRES: Append, Act
  // or EndEpisode follows; if it fails, the steps are not counted either.
  void SkipSteps(absl::Span<const double> rewards);
  // Puts `executed`, of the action space, in the place of the last answered action, without a
  // further decision. REQUIRES: the running episode has a decision.
  void ReportExecuted(const Action& executed);
  // As if the agent had reported an executed action: see AppendPendingAction().
  void ExpectExecutedActions() { context_.ExpectExecuted(); }

  // Replaces the last action in the history only: not in the stored answer, which retries return.
  // REQUIRES: the last call was Act.
  void OverrideLastAction(const Action& action) { session_.history.ReplaceLastAction(action); }

  // Ends the running episode. The next step is step 0 of the next episode. A repeated end before
  // the next decision is a retry: it returns the stored summary, and learns nothing. Errors do not
  // change the session: FAILED_PRECONDITION for any other end without a decision since the last
  // one; INVALID_ARGUMENT for a number that is not finite or an observation of the wrong length;
  // UNAVAILABLE if the fleet's head has not taken the contribution of the episode before yet.
  absl::StatusOr<EpisodeSummary> EndEpisode(const EpisodeEnd& end);
  // As a repeated EndEpisode, whatever was decided since. FAILED_PRECONDITION for another end.
  absl::StatusOr<EpisodeSummary> RepeatEnd(const EpisodeEnd& end);
  // Returns the contribution whose outcome the last returned summary may lack; null: it lacks none.
  const std::shared_ptr<FleetContribution>& contribution() const { return head_.contribution(); }

  void CountMissingRewards(int64_t rewards);  // that were left out after step 0, and are 0
  // Calls `listener` for the decisions and episodes after this call.
  void AddListener(std::shared_ptr<SessionListener> listener);

  void DropContext() { context_.Drop(); }  // the next decision makes it again
  // Frees all memory that the session's value does not need. For sessions that have been idle.
  void Compact();

  const Session& session() const { return session_; }
  const Policy& policy() const { return served_->policy(); }
  // Returns a summary of what the session has done since this object was created.
  const SessionLife& life() const { return life_; }
  // Returns whether the last answer has the neutral action, because of the verdict about the
  // wiring.
  bool acts_safely() const {
    return wiring_response_ == WiringResponse::kSafe && session_.wiring.verdict.has_value();
  }
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
  struct Together;  // the steps of ActTogether, and of EndEpisode

  void TakeExecuted(const Action& executed);
  // Replaces the action of the last answer by the neutral one.
  void ActSafely();
  // Counts an answer that holds NaN or infinity, and returns its error.
  absl::Status NonFiniteError() const;

  std::shared_ptr<const ServedPolicy> served_;
  const Clock* clock_;
  Session session_;
  absl::Duration created_;  // time of the clock
  SessionLife life_;
  ContextCache context_;
  SessionHead head_;
  WiringResponse wiring_response_;
  // The session before steps that were skipped, until the next decision; null: none were.
  std::unique_ptr<const Session> before_skipped_;
  std::vector<std::shared_ptr<SessionListener>> listeners_;
};

}  // namespace spikeserve

#endif  // CORE_AGENT_AGENT_SESSION_H_
