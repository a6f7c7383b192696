// Who acts while an episode is recorded, and what would have been right.
//
// An actor plays one episode; it keeps references to what it was made from.
#ifndef TRAIN_DATA_ACTORS_H_
#define TRAIN_DATA_ACTORS_H_

#include <cstdint>
#include <functional>

#include "absl/types/optional.h"
#include "absl/types/span.h"
#include "core/action/action_space.h"
#include "core/engine/engine.h"
#include "train/expert/expert.h"

namespace spikeserve {

// One step as an actor sees it.
struct View {
  absl::Span<const double> state;       // Environment::state()
  absl::Span<const float> observation;  // [obs]
  double reward;                        // of the action before, 0 at first
};

struct Decision {
  Action action;
  absl::optional<Action> label;  // what would have been right; nothing where that is the action
};

using Actor = std::function<Decision(const View&)>;

// Random bits for a step and a draw within it.
using Draws = std::function<uint64_t(uint64_t step, uint64_t draw)>;

struct Bursts {
  double rate;  // most; each episode draws its own below: the probability that one begins at a step
  int longest;  // steps; a burst is 1 to this many random actions
};

Actor ExpertActor(Expert& expert);

// The expert, but for bursts of random actions; labelled by the expert.
Actor DisturbedActor(Expert& expert, const ActionSpace& space, const Bursts& bursts, Draws draws);

// The engine's policy, greedily, asked for `target_return`; labelled by the expert.
Actor StudentActor(Expert& expert, const Engine& engine, uint64_t seed, double target_return);

// Uniformly random actions.
Actor RandomActor(const ActionSpace& space, Draws draws);

}  // namespace spikeserve

#endif  // TRAIN_DATA_ACTORS_H_
