// Controllers that stand for an expert in offline data.
#ifndef TRAIN_EXPERT_H_
#define TRAIN_EXPERT_H_

#include <functional>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/types/span.h"
#include "core/model/action_space.h"

namespace spikeserve {

// From an observation in environment units to an action.
using Controller = std::function<Action(absl::Span<const float> observation)>;

// The expert for an environment: for CartPole, push right iff 0.1 x + 0.3 x' + 3 theta + theta' >
// 0. NOT_FOUND names the environments there is one for.
absl::StatusOr<Controller> MakeExpert(absl::string_view environment);

}  // namespace spikeserve

#endif  // TRAIN_EXPERT_H_
