// Plays a task as if the server were far away, in steps and without a clock. As Distance of the
// Python client, with the same meaning; the draws are others.
#pragma once

#include <cstdint>
#include <vector>

#include "absl/status/status.h"
#include "core/action/action_space.h"
#include "core/cli/flag_group.h"

namespace spikeserve {

// How many steps pass between an observation and the effect of its decision. Each decision is
// executed `delay` steps after its observation, and up to `jitter` steps later. Of the decisions,
// the share `loss` never arrives. In the meantime the last action is executed.
struct Distance {
  int delay = 0;
  int jitter = 0;
  double loss = 0.0;

  // Returns whether every decision is executed at once.
  bool is_none() const { return delay == 0 && jitter == 0 && loss == 0.0; }
  // Returns INVALID_ARGUMENT that names the flag, the expected and the received value.
  absl::Status Validate() const;
};

// Adds --delay, --jitter and --loss.
void AddDistanceFlags(FlagGroup& group, Distance* distance);

// The decisions of one episode that are under way. `seed` decides about jitter and loss.
//
// Not thread-safe.
class Arrivals {
 public:
  Arrivals(const Distance& distance, const ActionSpace& space, uint64_t seed);

  // Returns the action that is executed at the next step, for whose observation `decided` is. An
  // older decision never follows a newer one.
  const Action& Executed(Action decided);

 private:
  struct Decision {
    int64_t arrives = 0;  // at this step
    int64_t of = 0;       // step of the observation
    Action action;
  };

  const Distance distance_;
  const uint64_t seed_;
  int64_t step_ = 0;
  std::vector<Decision> under_way_;
  int64_t newest_ = -1;  // step of the observation whose decision is executed
  Action action_;
};

}  // namespace spikeserve
