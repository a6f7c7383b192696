// How returns are scaled for each environment.
#ifndef TRAIN_TRAINER_TASK_H_
#define TRAIN_TRAINER_TASK_H_

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

// The return token's input is (G - offset) / scale; a policy is asked for `target` unless told
// otherwise.
struct ReturnScaling {
  float offset;
  float scale;
  float target;
};

// NOT_FOUND names the environments there are.
absl::StatusOr<ReturnScaling> ReturnScalingOf(absl::string_view id);

}  // namespace spikeserve

#endif  // TRAIN_TRAINER_TASK_H_
