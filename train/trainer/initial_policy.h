// Creates the policy that training starts from.
#ifndef TRAIN_TRAINER_INITIAL_POLICY_H_
#define TRAIN_TRAINER_INITIAL_POLICY_H_

#include <cstdint>

#include "core/model/policy.h"
#include "train/data/dataset.h"

namespace spikeserve {

// Returns a policy with random weights, drawn from `seed`. Observations are standardised by the
// moments of the data. Returns are scaled by ReturnScalingOf(), or by the moments of the data for
// an environment that it does not know. REQUIRES: a valid config and at least one episode.
Policy InitialPolicy(const ModelConfig& config, const Dataset& dataset, uint64_t seed);

}  // namespace spikeserve

#endif  // TRAIN_TRAINER_INITIAL_POLICY_H_
