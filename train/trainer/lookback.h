// Initial weights whose attention looks a fixed number of timesteps back.
//
// Where the action depends on what was observed exactly D steps ago, attention has to find one of
// many timesteps by its phase spikes alone. From random weights, whose attention is nearly uniform,
// training does not find it when D is large, because the gradient of one timestep is lost among
// those of all others.
//
// Pure functions; safe to call from many threads.
#ifndef TRAIN_TRAINER_LOOKBACK_H_
#define TRAIN_TRAINER_LOOKBACK_H_

#include "absl/status/status.h"
#include "core/model/policy.h"

namespace spikeserve {

// Sets the phase generators, and the weights of query and key in the first layer that read them, so
// that the attention of every head is largest at the timestep `delay` steps back:
//
//   omega_k = (2 m_k + 1) pi / delay
//
// A generator is then in antiphase to itself `delay` steps ago. A query fires at the phase spikes
// of generator k, or between them, and a key fires where the query `delay` steps later does, so
// that the two have the most common spikes at that timestep. The odd multiples are chosen so that
// the generators agree as little as possible at all other timesteps. All other weights stay
// as they are, and training changes these weights, too.
//
// Returns INVALID_ARGUMENT, for the flag --lookback, unless the policy has phase spikes with the
// clock `timestep`, and 1 <= delay < context.
absl::Status LookBack(int delay, Policy* policy);

}  // namespace spikeserve

#endif  // TRAIN_TRAINER_LOOKBACK_H_
