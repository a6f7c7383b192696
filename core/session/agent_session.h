// What an agent's requests do to its session, with no network in sight.
//
// Beside the session's value stand caches: the engine's context, rebuilt from the history whenever
// it is absent, and a head of its own, rebuilt from its delta. No answer depends on whether they
// were. A fleet session's head is not its own: each decision is made with the fleet's as it stands,
// and the session holds no more than what its running episode has to give to it.
//
// Not thread-safe: one caller at a time.
#ifndef CORE_SESSION_AGENT_SESSION_H_
#define CORE_SESSION_AGENT_SESSION_H_

#include <cstdint>
#include <memory>
#include <optional>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/types/span.h"
#include "core/base/clock.h"
#include "core/engine/engine.h"
#include "core/session/episode.h"
#include "core/session/episode_recorder.h"
#include "core/session/served_policy.h"
#include "core/session/session.h"

namespace spikeserve {

class AgentSession {
 public:
  // Goes on from `session`, which may be new or restored; a new one that learns gets its learner.
  // `clock` times decisions and must outlive this object. REQUIRES: `session` was opened on this
  // policy, or restored from one that was.
  AgentSession(std::shared_ptr<const ServedPolicy> served, Session session, const Clock* clock);

  // Decides timestep `step` from `observation` [obs], in environment units, and the reward of the
  // action before it, which is ignored at step 0. The returned answer lives until the next call
  // that changes the session.
  //
  // The last answered step again is a retry: it gets the stored answer, whatever else the request
  // carries, and nothing is counted twice. Errors leave the session as it was: FAILED_PRECONDITION
  // for any other step; INVALID_ARGUMENT for an observation of another length or a number that is
  // not finite.
  absl::StatusOr<const Answer*> Act(int64_t step, absl::Span<const float> observation,
                                    double reward);

  // Takes a_t into the context, if that is still to be done. Act does it where nobody has; calling
  // this once the answer has been sent keeps it out of the next answer's latency.
  void AppendPendingAction();

  // One of several calls of Act.
  struct ActCall {
    AgentSession* session = nullptr;
    int64_t step = 0;
    absl::Span<const float> observation;
    double reward = 0.0;
    absl::StatusOr<const Answer*> answer = nullptr;  // what Act would have returned
    bool is_retry = false;                           // and so nothing was decided
  };

  // Act and AppendPendingAction for several sessions, all distinct, with equal bits: those of one
  // policy version fetch its weights once. What that takes is divided evenly between their answers'
  // `compute_seconds`.
  static void ActTogether(absl::Span<ActCall> calls);
  static void AppendPendingActions(absl::Span<AgentSession* const> sessions);

  // Replaces the action of the last answer in the history: the window then sees what was really
  // done. The answer itself stays as it was, for retries. REQUIRES: Act was the last call.
  void OverrideLastAction(const Action& action) { session_.history.ReplaceLastAction(action); }

  // Ends the running episode and makes the session ready for the next, whose first step is 0.
  //
  // The last end again, before the next decision, is a retry: it gets the stored summary, and
  // nothing is counted or learned twice. Any other end without a decision since the last one is
  // FAILED_PRECONDITION; a number that is not finite, or an observation of another length, is
  // INVALID_ARGUMENT. Errors leave the session as it was.
  absl::StatusOr<EpisodeSummary> EndEpisode(const EpisodeEnd& end);

  // Has the episodes from the next one on recorded.
  void RecordTo(std::unique_ptr<EpisodeRecorder> recorder) { recorder_ = std::move(recorder); }

  // Gives the cache back; the next decision rebuilds it.
  void DropContext();

  // For a session that is not used for a while: gives back all memory that its value does not need.
  void Compact();

  const Session& session() const { return session_; }

  // W - W_base of the head the next decision is made with, [act, d]; empty where it is the
  // policy's.
  std::vector<float> HeadDelta() const;
  // |W - W_base| / |W_base|.
  double HeadDrift() const;
  // Of the head it learns, by a guard or an operator; 0 for a frozen session.
  int64_t Rollbacks() const;

 private:
  absl::Status CheckRequest(int64_t step, absl::Span<const float> observation, double reward) const;
  // Of a request for the next step: the reward of step 0 is nobody's.
  double UsedReward(double reward) const { return session_.step == 0 ? 0.0 : reward; }
  double NextReturnToGo(double reward) const;
  // Whether `call` asks for a new decision; otherwise it has its answer.
  static bool IsNewDecision(ActCall& call);
  // Decides for sessions of one version.
  static void Decide(absl::Span<ActCall* const> calls);
  void RebuildContext();
  absl::Span<const float> EncodedAction(const Action& action, std::vector<float>* encoded) const;
  Answer Choose(const Engine::Output& output, double return_to_go, double reward);
  bool InFleet() const;
  void ChooseWithHead(absl::Span<const float> readout, ActionChoice* choice) const;
  void TakeOutcome(std::optional<UpdateOutcome> outcome);
  std::optional<LearningSummary> LearnFromEpisode(const EpisodeEnd& end, double episode_return);
  void GiveToFleet(double episode_return, LearningSummary* summary);
  void KeepToItself(double episode_return, LearningSummary* summary);
  void Record(Answer answer, absl::Span<const float> observation, double return_to_go,
              double reward);

  std::shared_ptr<const ServedPolicy> served_;
  const Clock* clock_;
  Session session_;
  std::unique_ptr<Engine::Context> context_;  // null: to be rebuilt
  std::optional<Linear> head_;  // its own; absent where the policy's or fleet's serves
  std::unique_ptr<EpisodeRecorder> recorder_;  // null: nothing is recorded
  bool action_pending_ = false;                // the context still lacks the last timestep's action
};

// A new session's value, at step 0 of its first episode.
Session NewSession(std::string id, SessionOptions options);

// INVALID_ARGUMENT names `field` unless `target_return` is finite as the float the model reads.
absl::Status CheckTargetReturn(double target_return);

// The figure a decision's `energy_joules` reports: spike_5pj, or horowitz_45nm for a dense policy,
// which has no spikes. An estimate.
double PrimaryEnergy(const Counts& counts, bool dense);

}  // namespace spikeserve

#endif  // CORE_SESSION_AGENT_SESSION_H_
