// Defines what follows a session while it is played: its recording, its journal, a roll-out.
//
//   agent.AddListener(std::make_shared<EpisodeRecorder>(served, sink));
//
// A session calls its listeners in the order in which they were added, under its lock. They return
// quickly and never call back into the session.
#pragma once

#include <memory>
#include <optional>

#include "absl/types/span.h"
#include "core/action/action_space.h"
#include "core/session/session.h"

namespace spikeserve {

class FleetContribution;

// What a decision was made of, beside the last timestep of the session's history. Views that are
// valid during the call.
struct DecisionInputs {
  double reward = 0.0;  // that the decision counted; 0 at step 0
  // The action that was executed at the previous step, if the agent reported it.
  std::optional<Action> executed = std::nullopt;
  StepSource source;                // who chose the action that was executed at the previous step
  absl::Span<const float> readout;  // [d]: input of the action head
  absl::Span<const float> noise;    // as ActionChoice::noise
  bool is_beat = false;             // the agent took the step without the server
  bool after_gap = false;           // the session has skipped the steps before this one
  bool needs_snapshot = false;      // a journal's entry alone would not restore the session
};

class SessionListener {
 public:
  virtual ~SessionListener() = default;

  // `session` has made a decision: its last_answer.
  virtual void OnDecision(const Session& /*session*/, const DecisionInputs& /*inputs*/) {}

  // `executed` has taken the place of the last answered action. A decision, the end of the episode
  // or OnChange() follows.
  virtual void OnExecuted(const Action& /*executed*/) {}

  // `session` has changed otherwise than by a decision or the end of an episode.
  virtual void OnChange(const Session& /*session*/) {}

  // Steps are skipped. A decision follows.
  virtual void OnGap() {}

  // `session` has ended an episode: its last_end. Returns true if the listener appends
  // `contribution`, which the episode makes to the head of a fleet (null: none), to the log of the
  // head, once the session is stored. Otherwise the session appends it at once.
  virtual bool OnEpisodeEnd(const Session& /*session*/,
                            const std::shared_ptr<FleetContribution>& /*contribution*/) {
    return false;
  }

  // An episode that waited for its verdict has been learned from: the last of `session.verdicts`.
  // Otherwise as OnEpisodeEnd.
  virtual bool OnVerdict(const Session& /*session*/,
                         const std::shared_ptr<FleetContribution>& /*contribution*/) {
    return false;
  }

  // The policy failed to decide; the session has not changed. Errors of the caller are not
  // reported.
  virtual void OnFailure() {}
};

}  // namespace spikeserve
