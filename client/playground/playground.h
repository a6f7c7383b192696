// Plays a policy in the simulator of its task, without a server. The playground page of the
// documentation runs it in the browser, compiled to WebAssembly.
//
//   auto playground = Playground::Open(policy_file, /*seed=*/0);
//   const absl::StatusOr<nlohmann::json> decision = (*playground)->Step();
//
// Not thread-safe.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "core/agent/agent_session.h"
#include "core/agent/served_policy.h"
#include "core/base/clock.h"
#include "core/environment/environment.h"
#include "nlohmann/json.hpp"

namespace spikeserve {

// A session on one policy, and the environment that it acts in. Episode e starts as Gymnasium's
// reset(seed + e).
class Playground {
 public:
  // `policy_file` is the content of a policy file. INVALID_ARGUMENT if it is not one; NOT_FOUND if
  // its environment is not one of core/environment; INVALID_ARGUMENT if the policy does not fit the
  // environment.
  static absl::StatusOr<std::unique_ptr<Playground>> Open(absl::string_view policy_file,
                                                          uint64_t seed);

  // Decides once and takes the action; begins a new episode if the last step has ended one. Returns
  // the decision as DecisionToJson (playground.cc), with
  // - environment: Gymnasium's name,
  // - seed: of the episode's reset,
  // - episode_return: the rewards of the episode, with that of this action,
  // - ended: whether the action has ended the episode.
  // Errors: see AgentSession::Act.
  absl::StatusOr<nlohmann::json> Step();

  // Recomputes the last decision. Returns it as Step() did, with its spikes, gates and attention.
  // Takes about a thousand times as long. FAILED_PRECONDITION before the first step.
  absl::StatusOr<nlohmann::json> Explain() const;

 private:
  Playground(std::shared_ptr<const ServedPolicy> served, std::unique_ptr<Environment> environment,
             Session session, uint64_t seed);

  // Tells the session that the episode has ended, and starts the next one.
  absl::Status BeginEpisode();
  // Adds what Step() says about the episode to a decision.
  void AddEpisode(nlohmann::json* decision) const;

  const std::shared_ptr<const ServedPolicy> served_;
  const std::unique_ptr<Environment> environment_;
  const SteadyClock clock_;
  AgentSession agent_;
  uint64_t seed_;     // of the running episode
  StepResult state_;  // after the last action
  double episode_return_ = 0.0;
};

}  // namespace spikeserve
