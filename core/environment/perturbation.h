// The tasks under other physics than those they were trained for: what plasticity has to make up
// for.
//
// Free functions, safe to call from many threads.
#ifndef CORE_ENVIRONMENT_PERTURBATION_H_
#define CORE_ENVIRONMENT_PERTURBATION_H_

#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "core/environment/environment.h"

namespace spikeserve {

// One physical constant of a task, changed:
//   wind     newtons on the cart, to the right (CartPole)
//   length   factor on every length, moments of inertia along (not MountainCar)
//   mass     factor on every mass, moments of inertia along (not MountainCar)
//   force    factor on what the actuator does with an action; -1 reverses it
//   gravity  factor on gravity
struct Perturbation {
  std::string name;
  double value = 0.0;
};

// From "NAME=VALUE". INVALID_ARGUMENT unless VALUE is a finite number.
absl::StatusOr<Perturbation> ParsePerturbation(absl::string_view text);

// MakeEnvironment with one constant changed. NOT_FOUND names the ids there are; INVALID_ARGUMENT
// the perturbations this task has, or that a length or mass must be above 0.
absl::StatusOr<std::unique_ptr<Environment>> MakePerturbedEnvironment(
    absl::string_view id, const Perturbation& perturbation);

}  // namespace spikeserve

#endif  // CORE_ENVIRONMENT_PERTURBATION_H_
