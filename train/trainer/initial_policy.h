// Where training starts.
#ifndef TRAIN_TRAINER_INITIAL_POLICY_H_
#define TRAIN_TRAINER_INITIAL_POLICY_H_

#include <cstdint>

#include "core/model/policy.h"
#include "train/data/dataset.h"

namespace spikeserve {

// Random weights, observations standardised by the data's moments, returns scaled as suits the
// environment (by the data's moments where it is not one of ours). REQUIRES: a valid config.
Policy InitialPolicy(const ModelConfig& config, const Dataset& dataset, uint64_t seed);

}  // namespace spikeserve

#endif  // TRAIN_TRAINER_INITIAL_POLICY_H_
