// A policy that plays one episode, greedily.
//
// Not thread-safe; the engine may be shared.
#ifndef TRAIN_DATA_POLICY_PLAYER_H_
#define TRAIN_DATA_POLICY_PLAYER_H_

#include <cstdint>
#include <memory>
#include <vector>

#include "absl/status/status.h"
#include "absl/types/span.h"
#include "core/engine/engine.h"
#include "core/environment/environment.h"

namespace spikeserve {

// INVALID_ARGUMENT if the policy's observations or actions are not the environment's.
absl::Status CheckFits(const Policy& policy, const Environment& environment);

class PolicyPlayer {
 public:
  // Keeps a reference to `engine`. `seed` keys the Bernoulli coder.
  PolicyPlayer(const Engine& engine, uint64_t seed, double target_return);

  // The action at the next step. `reward` is the previous action's, and ignored at first.
  Action Act(absl::Span<const float> observation, double reward);

  // What the last decision took.
  const Counts& counts() const { return output_.counts; }

 private:
  const Engine& engine_;
  const std::unique_ptr<Engine::Context> context_;
  double return_to_go_;
  Engine::Output output_;
  std::vector<float> encoded_;  // [act], the previous action; empty before the first
};

}  // namespace spikeserve

#endif  // TRAIN_DATA_POLICY_PLAYER_H_
