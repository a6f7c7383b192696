// Trains the same policy with several seeds, and keeps the best.
#pragma once

#include <string>

#include "absl/status/status.h"
#include "train/train_run.h"

namespace spikeserve {

// Trains with each of --seeds into --out/seed-N, one after the other, and prints the return of each
// policy, their mean and their standard deviation. All policies play the same starts, from seed
// 1,000,000 on, which no final evaluation uses. Copies the policy with the highest mean return to
// --out/policy.safetensors. Returns INVALID_ARGUMENT if a seed is not a number or not unique, or if
// spiketrain cannot play the environment.
absl::Status TrainSeeds(const TrainFlags& flags, const std::string& command_line);

}  // namespace spikeserve
