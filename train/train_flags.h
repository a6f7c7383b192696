// What the flags of `spiketrain train` ask for.
#ifndef TRAIN_TRAIN_FLAGS_H_
#define TRAIN_TRAIN_FLAGS_H_

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/model/config.h"
#include "core/model/policy.h"
#include "train/data/dataset.h"
#include "train/trainer/trainer.h"

namespace spikeserve {

// The options of the trainer. INVALID_ARGUMENT names the flag.
absl::StatusOr<TrainOptions> TrainOptionsFromFlags();

// --data, or a recording by the default recipe. INVALID_ARGUMENT if --env is given and is not the
// data's.
absl::StatusOr<Dataset> DatasetFromFlags();

// Sets in `config` what the flags of the shape ask for. INVALID_ARGUMENT names the flag.
absl::Status SetShapeFromFlags(ModelConfig* config);

// Where training starts: --init, or random weights of the shape that --mode, --hidden_size and so
// on ask for, with the data's standardisation and the environment's return scaling. Flags of the
// shape that contradict --init are INVALID_ARGUMENT.
absl::StatusOr<Policy> InitialPolicyFromFlags(const Dataset& dataset);

}  // namespace spikeserve

#endif  // TRAIN_TRAIN_FLAGS_H_
