// Actors choose the actions while an episode is recorded, and label each step with the action to
// imitate.
//
// An actor plays one episode. It keeps references to the objects it was made from, which must
// outlive it.
#pragma once

#include <cstdint>
#include <functional>

#include "absl/types/optional.h"
#include "absl/types/span.h"
#include "core/action/action_space.h"
#include "core/engine/engine.h"
#include "train/expert/expert.h"

namespace spikeserve {

// The input of an actor at one step.
struct View {
  absl::Span<const double> state;       // Environment::state()
  absl::Span<const float> observation;  // [obs]
  double reward;                        // of the previous action; 0 at the first step
};

struct Decision {
  Action action;
  absl::optional<Action> label;  // the action to imitate; absent if it is `action` itself
};

using Actor = std::function<Decision(const View&)>;

// Returns random bits for one draw within one step.
using Draws = std::function<uint64_t(uint64_t step, uint64_t draw)>;

// Bursts of random actions.
struct Bursts {
  // Upper bound of the burst rate, the probability that a burst begins at a step outside one. Each
  // episode draws its own rate, uniform in [0, rate).
  double rate;
  int longest;  // a burst lasts 1 to `longest` steps
};

// Plays the expert's actions.
Actor ExpertActor(Expert& expert);

// Plays the expert's actions, interrupted by bursts of random actions. The labels are the expert's
// actions.
Actor DisturbedActor(Expert& expert, const ActionSpace& space, const Bursts& bursts, Draws draws);

// Plays the engine's policy greedily, conditioned on `target_return`. The labels are the expert's
// actions.
Actor StudentActor(Expert& expert, const Engine& engine, double target_return);

// Plays uniformly random actions.
Actor RandomActor(const ActionSpace& space, Draws draws);

}  // namespace spikeserve
