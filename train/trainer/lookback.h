// Initial weights whose attention looks at a known timestep: a fixed number of steps back, or as
// far before a middle as the present timestep is after it.
//
// Where the action depends on what was observed at one of many timesteps, attention has to find it
// by its phase spikes alone. From random weights, whose attention is
// nearly uniform, training does not find a distant one, because its gradient is lost among those of
// all others.
//
// Pure functions; safe to call from many threads.
#pragma once

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

// Sets the same weights so that at timestep `middle` + x the attention of every head is largest at
// `middle` - x and at the present timestep:
//
//   sin(omega_k tau + phi_k) = cos(omega_k (tau - middle)),  omega_0 = pi
//   omega_k = m_k pi / (middle + 2)
//
// These generators fire equally at equal distances from the middle, and a query and a key fire with
// the same one. Within a timestep, time moves away from the middle after it and towards the middle
// before it, which blurs the match by up to one step. Generator 0 therefore separates even from odd
// timesteps. The other multiples are chosen so that attention at all other timesteps is least. Odd
// multiples of pi / middle would all change their spikes halfway between the middle and the ends.
//
// Returns INVALID_ARGUMENT, for the flag --mirror, unless the policy has phase spikes with the
// clock `timestep`, and 1 <= middle < context / 2.
absl::Status Mirror(int middle, Policy* policy);

}  // namespace spikeserve
