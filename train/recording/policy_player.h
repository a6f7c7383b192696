// Plays one episode with a policy, greedily.
//
// Not thread-safe. Several players on different threads may share an engine.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "absl/status/status.h"
#include "absl/types/span.h"
#include "core/engine/engine.h"
#include "core/environment/environment.h"
#include "train/data/dataset.h"

namespace spikeserve {

// Returns INVALID_ARGUMENT unless the policy's observation size and action space equal the
// environment's.
absl::Status CheckSpacesMatch(const Policy& policy, const Environment& environment);
// Return INVALID_ARGUMENT, which names the flag --data, unless recorded episodes have the spaces of
// the policy or of the environment.
absl::Status CheckSpacesMatch(const Policy& policy, const Dataset& dataset);
absl::Status CheckSpacesMatch(const Environment& environment, const Dataset& dataset);

class PolicyPlayer {
 public:
  // Keeps a reference to `engine`.
  PolicyPlayer(const Engine& engine, double target_return);

  // Decides the next action. `reward` is the reward of the previous action; it is ignored at the
  // first step.
  Action Act(absl::Span<const float> observation, double reward);

  // Replaces what the policy remembers of its last action by what was executed.
  // REQUIRES: Act() was called.
  void Executed(const Action& action);

  // Returns the spikes and operations of the last decision.
  const Counts& counts() const { return output_.counts; }

 private:
  const Engine& engine_;
  const std::unique_ptr<Engine::Context> context_;
  double return_to_go_;
  Engine::Output output_;
  std::vector<float> encoded_;  // [act], the previous action; empty before the first decision
};

}  // namespace spikeserve
