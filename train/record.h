// Records the offline data of the paper's recipe: part expert steps, part random steps.
#ifndef TRAIN_RECORD_H_
#define TRAIN_RECORD_H_

#include <cstdint>
#include <string>

#include "absl/status/statusor.h"
#include "train/dataset.h"

namespace spikeserve {

// Environment seeds below this one are for data; those from it on are never trained on and are for
// evaluation.
inline constexpr uint64_t kFirstEvaluationSeed = 1'000'000;

struct RecordOptions {
  std::string environment = "CartPole-v1";
  uint64_t seed = 0;
  int steps = 10'000;            // at least; the last episodes are completed
  double expert_fraction = 0.5;  // of the steps

  absl::Status Validate() const;
};

// Whole episodes of the expert, then of uniformly random actions, until each has its share of the
// steps. A pure function of the options. NOT_FOUND for an unknown environment, or one without an
// expert.
absl::StatusOr<Dataset> RecordDataset(const RecordOptions& options);

}  // namespace spikeserve

#endif  // TRAIN_RECORD_H_
