// Applies an agent's requests to its session, without any network code.
//
//   AgentSession agent(served, NewSession(id, options), clock);
//   absl::StatusOr<const Answer*> answer = agent.Act(/*step=*/0, observation, /*reward=*/0.0);
//   agent.AppendPendingAction();  // after the answer was sent
//
// An AgentSession holds the session's value and two caches: the engine's context, which is rebuilt
// from the history if it is absent, and a private head, which is rebuilt from its delta. Answers do
// not depend on whether the caches are present. A session of scope fleet has no private head: each
// decision uses the current fleet head, and the session stores only what its running episode will
// contribute to it.
//
// Not thread-safe: one caller at a time.
#ifndef CORE_SESSION_AGENT_SESSION_H_
#define CORE_SESSION_AGENT_SESSION_H_

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
#include "core/action/reported_action.h"
#include "core/base/clock.h"
#include "core/engine/engine.h"
#include "core/session/episode.h"
#include "core/session/episode_recorder.h"
#include "core/session/head_log.h"
#include "core/session/served_policy.h"
#include "core/session/session.h"
#include "core/session/session_journal.h"
#include "core/session/session_life.h"

namespace spikeserve {

// One agent's session on one policy version.
class AgentSession {
 public:
  // Continues `session`, which is new or restored. Creates its learner if it learns and has none.
  // `clock` measures `compute_seconds` and must outlive this object. REQUIRES: `session` was opened
  // on this policy, or restored from a session that was.
  AgentSession(std::shared_ptr<const ServedPolicy> served, Session session, const Clock* clock);

  // Decides timestep `step` from `observation` [obs], in environment units, and from `reward`,
  // which the previous action earned and which is ignored at step 0. `executed` is the action that
  // was executed at the previous step, if it differs from the answered one; it takes the answer's
  // place in the history, in learning and in recordings, and is ignored at step 0. The returned
  // answer is valid until the next call that changes the session.
  //
  // A request for the step that was answered last is a retry: it returns the stored answer,
  // whatever its other arguments are, and nothing is counted twice. Errors do not change the
  // session: FAILED_PRECONDITION for any other step than the next one; INVALID_ARGUMENT for an
  // observation of the wrong length, a number that is not finite or an executed action outside the
  // action space; INTERNAL, which names the policy, if the policy's answer is not finite.
  absl::StatusOr<const Answer*> Act(int64_t step, absl::Span<const float> observation,
                                    double reward,
                                    const std::optional<ReportedAction>& executed = std::nullopt);

  // Appends the last action to the engine's context if that is still to be done. Act does it
  // otherwise: a call after the answer was sent keeps this work out of the latency of the next
  // answer. Does nothing once the agent has reported an executed action, because the next request
  // may replace the action.
  void AppendPendingAction();

  // The arguments and the result of one Act among several.
  struct ActCall {
    AgentSession* session = nullptr;
    int64_t step = 0;
    absl::Span<const float> observation;
    double reward = 0.0;
    // Number of the decision in the session, from 0; absent: `step` alone identifies the request.
    std::optional<uint64_t> decision = std::nullopt;
    std::optional<ReportedAction> executed = std::nullopt;
    // True: nobody asked for the decision; it is a step that the agent took without the server.
    bool is_beat = false;
    absl::StatusOr<const Answer*> answer = nullptr;  // what Act would return
    bool is_retry = false;                           // true: `answer` is the stored one
  };

  // As Act and AppendPendingAction, for several different sessions, with results that are equal bit
  // for bit. Sessions of one policy version load its weights once. The time of their common work is
  // divided evenly between the `compute_seconds` of their answers.
  static void ActTogether(absl::Span<ActCall> calls);
  static void AppendPendingActions(absl::Span<AgentSession* const> sessions);

  // The methods below add what the agent did without the server; beats.h checks it and calls them.

  // Adds the next step as Act decides it, but counts no decision for the observer.
  absl::Status Append(absl::Span<const float> observation, double reward,
                      const std::optional<ReportedAction>& executed);
  // Counts the rewards of the next steps, whose observations are not known. The next step begins
  // the context. REQUIRES: Append or Act follows; if it fails, the steps are not counted either.
  void SkipSteps(absl::Span<const double> rewards);
  // Puts `executed` in the place of the last answered action, without a further decision. REQUIRES:
  // the running episode has a decision; `executed` belongs to the action space.
  void ReportExecuted(const Action& executed);
  // As if the agent had reported an executed action: see AppendPendingAction().
  void ExpectExecutedActions() { reports_actions_ = true; }

  // Replaces the action of the last answer in the history by the action that was really executed,
  // so that later decisions take it into account. Does not change the stored answer, which retries
  // return. REQUIRES: the last call was Act.
  void OverrideLastAction(const Action& action) { session_.history.ReplaceLastAction(action); }

  // Ends the running episode. The next step is step 0 of the next episode.
  //
  // If the last end is repeated before the next decision, it is a retry: the stored summary is
  // returned, and nothing is counted or learned twice. Errors do not change the session:
  // FAILED_PRECONDITION for any other end without a decision since the last one; INVALID_ARGUMENT
  // for a number that is not finite or an observation of the wrong length; UNAVAILABLE if the
  // contribution of the episode before is not in the log of the fleet's head yet.
  absl::StatusOr<EpisodeSummary> EndEpisode(const EpisodeEnd& end);

  // Returns the contribution of the last episode that has ended, whose outcome the summary that the
  // last EndEpisode has returned may lack. Null: it lacks nothing.
  const std::shared_ptr<FleetContribution>& contribution() const { return contribution_; }

  // Records the episodes that start after this call.
  void RecordTo(std::unique_ptr<EpisodeRecorder> recorder) { recorder_ = std::move(recorder); }

  // Reports the decisions and episodes after this call to `evidence`; null: to none.
  void ReportTo(std::shared_ptr<SessionEvidence> evidence) { evidence_ = std::move(evidence); }

  // Returns where the recording of the last episode that has ended is now.
  RecordingState recording_state() const {
    return recorder_ == nullptr ? RecordingState::kNotRecorded : recorder_->last_state();
  }

  // Writes the decisions and episodes after this call to `journal`.
  void JournalTo(std::shared_ptr<SessionJournal> journal) { journal_ = std::move(journal); }

  // Frees the engine's context. The next decision rebuilds it.
  void DropContext();

  // Frees all memory that the session's value does not need. For sessions that have been idle.
  void Compact();

  const Session& session() const { return session_; }
  const Policy& policy() const { return served_->policy(); }

  // Returns a summary of what the session has done since this object was created.
  const SessionLife& life() const { return life_; }
  // Returns when this object was created, of the clock. Not guarded by the lock of the session.
  absl::Duration created() const { return created_; }
  // Returns the time since this object was created.
  absl::Duration Age() const { return clock_->Now() - created_; }

  // Returns the error with which ActTogether would refuse `call` as a new decision, or OK.
  absl::Status CheckNewDecision(const ActCall& call) const { return CheckRequest(call); }

  // Returns W - W_base of the head that the next decision uses, [act * d], row-major; empty if
  // it is the policy's head.
  Eigen::VectorXf HeadDelta() const;
  // Returns |W - W_base| / |W_base| of that head.
  double HeadDrift() const;
  // Returns how often a guard or an operator rolled back the head that this session learns; 0 for a
  // frozen session.
  int64_t Rollbacks() const;

 private:
  absl::Status CheckRequest(const ActCall& call) const;
  // Returns the reward that a request for the next step counts: 0 at step 0, where no action was
  // taken before.
  double CountedReward(double reward) const { return session_.step == 0 ? 0.0 : reward; }
  // Returns whether `call` requires a new decision. Otherwise sets its answer.
  static bool IsNewDecision(ActCall& call);
  // Decides for sessions of one policy version.
  static void Decide(absl::Span<ActCall* const> calls);
  // As AppendPendingActions, but also for agents that report executed actions.
  static void AppendActions(absl::Span<AgentSession* const> sessions);
  // Puts `executed` in the place of the last answered action. REQUIRES: the running episode has a
  // decision; `executed` belongs to the action space.
  void TakeExecuted(const Action& executed);
  void RebuildContext();
  absl::Span<const float> EncodedAction(const Action& action, std::vector<float>* encoded) const;
  // Counts an answer that holds NaN or infinity, and returns its error.
  absl::Status NonFiniteError() const;
  // Learns from `choice` and moves it into the answer. Leaves in `choice` what the answer does not
  // store.
  Answer TakeChoice(const Engine::Output& output, double return_to_go, double reward,
                    ActionChoice* choice);
  bool InFleet() const { return member_ != nullptr; }
  void ChooseWithHead(absl::Span<const float> readout, ActionChoice* choice) const;
  void TakeOutcome(std::optional<UpdateOutcome> outcome);
  std::optional<LearningSummary> LearnFromEpisode(const EpisodeEnd& end, double episode_return);
  void MergeIntoFleet(double episode_return, LearningSummary* summary);
  // Returns the contribution that `session_.pending` holds.
  std::shared_ptr<FleetContribution> NewContribution() const;
  // Completes the summary of the last episode when the outcome of its contribution is known.
  void TakeMerged();
  void WatchPrivateHead(double episode_return, LearningSummary* summary);
  void Record(Answer answer, absl::Span<const float> observation, double reward);
  // Writes the last decision to the journal, if there is one.
  void WriteToJournal(const ActCall& call, double reward, absl::Span<const float> readout,
                      absl::Span<const float> noise);

  std::shared_ptr<const ServedPolicy> served_;
  const Clock* clock_;
  Session session_;
  absl::Duration created_;  // time of the clock
  SessionLife life_;
  std::unique_ptr<Engine::Context> context_;  // null: rebuilt by the next decision
  std::optional<Linear> head_;  // private head; absent: the policy's or the fleet's head is used
  std::unique_ptr<FleetHead::Member> member_;  // of the head that the fleet shares; null: of none
  std::shared_ptr<FleetContribution> contribution_;  // of `session_.pending`; null: none
  std::unique_ptr<EpisodeRecorder> recorder_;        // null: nothing is recorded
  std::shared_ptr<SessionJournal> journal_;          // null: the session is not stored
  std::shared_ptr<SessionEvidence> evidence_;        // null: no roll-out compares the session
  // The session before steps that were skipped, until the next decision; null: none were.
  std::unique_ptr<const Session> before_skipped_;
  bool action_pending_ = false;   // true: the context lacks the last timestep's action
  bool reports_actions_ = false;  // true: the agent has reported an executed action
};

}  // namespace spikeserve

#endif  // CORE_SESSION_AGENT_SESSION_H_
