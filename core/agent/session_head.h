// Selects a session's actions and updates its action head from their rewards.
//
// The head is the policy's, or a private one, which is rebuilt from its delta, or the current head
// of the fleet. A session of a fleet stores only what its running episode will contribute to that
// head.
//
// Not thread-safe: protected by the lock of its session.
#pragma once

#include <cstdint>
#include <memory>
#include <optional>

#include "Eigen/Core"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "absl/types/span.h"
#include "core/action/action_head.h"
#include "core/agent/head_log.h"
#include "core/agent/served_policy.h"
#include "core/base/clock.h"
#include "core/learning/fleet_head.h"
#include "core/session/session.h"

namespace spikeserve {

// `session` is the same one in all calls.
class SessionHead {
 public:
  // Creates the learner of `session` if it learns and has none.
  SessionHead(std::shared_ptr<const ServedPolicy> served, Session* session);

  // Sets `choice` to the action of the next decision. `readout` [d] is the input of the head.
  void Choose(const Session& session, absl::Span<const float> readout, ActionChoice* choice) const;

  // The methods below learn, if the session does, and report the updates to the observer.

  void OnDecision(const ActionChoice& choice, absl::Span<const float> readout, double return_to_go,
                  double reward, Session* session);
  // Puts `executed` in the place of the last answered action, in the history too. REQUIRES: the
  // running episode has a decision; `executed` belongs to the action space.
  void OnExecuted(const Action& executed, Session* session);
  // Takes an operator's step: the action that was executed in the place of the last answered one,
  // or is answered in its place. REQUIRES: as OnExecuted.
  void OnOperator(const Action& executed, absl::string_view operator_id, Session* session);
  // As Learner::UndoCorrections, of the last `ago`; nothing is known of a head that is not private.
  std::optional<int64_t> UndoCorrections(absl::string_view operator_id, absl::Duration ago,
                                         Session* session);
  // Returns what the session has learned in the episode that `end` ends; nullopt if it is frozen.
  std::optional<LearningSummary> OnEpisodeEnd(const EpisodeEnd& end, double episode_return,
                                              const Clock& clock, Session* session);

  // Lets the episode that `end` ends wait for its verdict. Returns false, and does nothing, if
  // OnEpisodeEnd is to learn from it now.
  bool AwaitVerdict(const EpisodeEnd& end, Session* session);
  // As OnEpisodeEnd, for an episode that has waited: its rewards are final.
  LearningSummary OnVerdict(const WaitingEpisode& ended, double episode_return, const Clock& clock,
                            Session* session);

  // Returns what the last episode that has ended contributes to the head of the fleet, from
  // NewContribution() until TakeMerged() finds its outcome; otherwise null.
  const std::shared_ptr<FleetContribution>& contribution() const { return contribution_; }
  // Returns how many episodes have contributed to the head of the fleet in this process.
  int64_t contributions() const { return contributions_; }
  // Makes the contribution of `session.pending`, if there is one.
  void NewContribution(const Session& session);
  // Completes the summary of the last episode when the outcome of its contribution is known.
  void TakeMerged(Session* session);

  // As the methods of AgentSession.
  Eigen::VectorXf Delta(const Session& session) const;
  double Drift(const Session& session) const;
  int64_t Rollbacks(const Session& session) const;

 private:
  bool IsInFleet() const { return member_ != nullptr; }
  // Suspends the learning of the running episode if that of the policy is paused.
  void SuspendIfPaused(Session* session) const;
  void OnUpdate(std::optional<UpdateOutcome> outcome, const Session& session);
  // Learns from an episode with the rewards that the learner has and the last one.
  LearningSummary Learn(int64_t episode, double reward, bool terminated, double episode_return,
                        const Clock& clock, Session* session);
  void MergeIntoFleet(int64_t episode, double episode_return, const Clock& clock, Session* session,
                      LearningSummary* summary);
  void WatchPrivateHead(double episode_return, Session* session, LearningSummary* summary);

  std::shared_ptr<const ServedPolicy> served_;
  std::optional<Linear> private_head_;         // absent: the policy's or the fleet's head is used
  std::unique_ptr<FleetHead::Member> member_;  // null: of no fleet
  std::shared_ptr<FleetContribution> contribution_;
  int64_t contributions_ = 0;
};

}  // namespace spikeserve
