// Records offline data: the paper's recipe, part expert steps, part random steps; episodes of the
// expert disturbed by bursts of random actions, which show how to recover; and episodes of a
// student (DAgger: S. Ross, G. Gordon, D. Bagnell, AISTATS 2011), which show the states it gets
// into. In the last two the expert's action is the label of every step.
#ifndef TRAIN_DATA_RECORD_H_
#define TRAIN_DATA_RECORD_H_

#include <cstdint>
#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "core/model/policy.h"
#include "train/data/dataset.h"
#include "train/expert/expert.h"

namespace spikeserve {

// Environment seeds below this one are for data; those from it on are never trained on and are for
// evaluation.
inline constexpr uint64_t kFirstEvaluationSeed = 1'000'000;

inline constexpr double kLeastWeight = 0.15;
inline constexpr double kMostWeight = 3.0;

struct RecordOptions {
  ExpertOptions expert = {};  // and the environment
  uint64_t seed = 0;
  int steps = 10'000;               // at least; the last episodes are completed
  double expert_fraction = 0.5;     // of the steps
  double disturbed_fraction = 0.0;  // of the steps; the rest are the student's or else random
  std::shared_ptr<const Policy> student = nullptr;
  // Weight every label by what the worst action would lose, as far as the expert knows, clipped to
  // kLeastWeight and kMostWeight.
  bool weigh = false;

  // Each disturbed episode draws its own rate up to this: the probability that at a step without a
  // burst one begins. A burst is 1 to `longest_burst` random actions.
  double burst_rate = 0.3;
  int longest_burst = 8;
  // Of the disturbed episodes, those that start at any velocity an environment allows, not
  // only at the small ones of Reset. Pendulum-v1 and PositionOnlyPendulum-v1 only.
  double wide_start_fraction = 0.0;

  absl::Status Validate() const;

  // The flags of `spiketrain dataset` that ask for these options; not the seed, where tables are
  // kept, nor the student, which has no name here.
  std::string ToFlags() const;
};

// Whole episodes of the expert, then disturbed ones, then the student's or else of uniformly random
// actions, until each has its share of the steps. In a disturbed or a student's episode `actions`
// are what was done and `labels` what the expert would have done. A pure function of the options.
// NOT_FOUND for an unknown environment or expert, INVALID_ARGUMENT for a student that does not fit
// the environment.
absl::StatusOr<Dataset> RecordDataset(const RecordOptions& options);

}  // namespace spikeserve

#endif  // TRAIN_DATA_RECORD_H_
