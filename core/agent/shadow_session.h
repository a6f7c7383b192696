// Runs a candidate version beside a session that another version serves. The candidate decides what
// it would have answered, and then continues with the action that was really taken. Its answers are
// never sent to a client.
//
// Not thread-safe: one caller at a time.
#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "core/agent/agent_session.h"
#include "core/agent/served_policy.h"
#include "core/agent/session_listener.h"
#include "core/base/clock.h"

namespace spikeserve {

// One decision of the serving session.
struct ShadowStep {
  int64_t episode = 0;
  int64_t step = 0;
  std::vector<float> observation;  // environment units
  double reward = 0.0;
  double target_return = 0.0;                     // of the episode
  std::optional<Action> executed = std::nullopt;  // at the previous step; absent: as served
  Answer served;                                  // the answer that was sent
};

// The candidate's session.
class ShadowSession {
 public:
  // `candidate` must have the observation and action spaces of the serving policy; `options` are
  // those of the serving session. `clock` must outlive this object.
  ShadowSession(const ServedPolicy& candidate, const SessionOptions& options, const Clock* clock);

  // Returns the candidate's answer to `step`, which is valid until the next call. Step 0 starts an
  // episode. FAILED_PRECONDITION if an earlier step of the episode is missing; the rest of this
  // episode cannot be shadowed then.
  absl::StatusOr<const Answer*> Act(const ShadowStep& step);

  const ServedPolicy& candidate() const { return *candidate_; }

 private:
  const std::shared_ptr<const ServedPolicy> candidate_;  // with an observer that ignores all events
  AgentSession agent_;
  int64_t episode_ = 0;  // of the serving session
};

// Gathers the steps of the serving session for its shadow.
class ShadowSteps final : public SessionListener {
 public:
  void OnDecision(const Session& session, const DecisionInputs& inputs) override;
  void OnExecuted(const Action& executed) override { executed_ = executed; }

  bool empty() const { return steps_.empty(); }
  // Returns the steps since the last call.
  std::vector<ShadowStep> Take() { return std::exchange(steps_, {}); }

 private:
  std::vector<ShadowStep> steps_;
  std::optional<Action> executed_;  // since the last decision; absent: as served
};

// Returns whether two actions agree: equal indices, or for a Box, a difference of at most 1% of the
// range in every element.
bool Agree(const Action& a, const Action& b, const ActionSpace& space);

}  // namespace spikeserve
