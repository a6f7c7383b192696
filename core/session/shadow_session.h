// A candidate version beside a session that another version serves: it decides what it would have
// answered, and goes on with the action that was really taken. Nobody is ever sent its answers.
//
// Not thread-safe: one caller at a time.
#ifndef CORE_SESSION_SHADOW_SESSION_H_
#define CORE_SESSION_SHADOW_SESSION_H_

#include <cstdint>
#include <memory>
#include <vector>

#include "absl/status/statusor.h"
#include "core/base/clock.h"
#include "core/session/agent_session.h"
#include "core/session/served_policy.h"

namespace spikeserve {

// One decision of the session that serves.
struct ShadowStep {
  int64_t episode = 0;
  int64_t step = 0;
  std::vector<float> observation;  // environment units
  double reward = 0.0;
  double target_return = 0.0;  // of the episode
  Answer served;               // what was answered
};

class ShadowSession {
 public:
  // `candidate` has the spaces of the policy that serves; `options` are those of its session.
  // `clock` must outlive this object.
  ShadowSession(const ServedPolicy& candidate, const SessionOptions& options, const Clock* clock);

  // The candidate's answer to `step`, which lives until the next call. Step 0 starts an episode.
  // FAILED_PRECONDITION where a step before it is missing: then the rest of the episode is lost.
  absl::StatusOr<const Answer*> Act(const ShadowStep& step);

  const ServedPolicy& candidate() const { return *candidate_; }

 private:
  const std::shared_ptr<const ServedPolicy> candidate_;  // with an observer that counts nothing
  AgentSession agent_;
  int64_t episode_ = 0;  // of the session that serves
};

// Whether two answers are the same action; for a Box, within 1% of the range of every element.
bool Agree(const Action& a, const Action& b, const ActionSpace& space);

}  // namespace spikeserve

#endif  // CORE_SESSION_SHADOW_SESSION_H_
