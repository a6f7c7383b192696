// Makes the classic-control tasks with other physical constants than those that a policy was
// trained on, to measure how far plasticity makes up for the change.
//
// All functions are thread-safe.
#pragma once

#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "core/environment/environment.h"

namespace spikeserve {

// The change of one physical constant of a task. Names and values:
//
//   wind     force on the cart in newtons, positive to the right (CartPole)
//   length   factor on every length, with the moments of inertia adapted (not MountainCar)
//   mass     factor on every mass, with the moments of inertia adapted (not MountainCar)
//   force    factor on the actuator's effect; -1 reverses it
//   gravity  factor on gravity
struct Perturbation {
  std::string name;
  double value = 0.0;
};

// Parses "NAME=VALUE". INVALID_ARGUMENT unless VALUE is a finite number.
absl::StatusOr<Perturbation> ParsePerturbation(absl::string_view text);

// Makes the environment called `id` with one constant changed. NOT_FOUND for an unknown id; the
// message lists the known ids. INVALID_ARGUMENT if the task has no such perturbation, in which case
// the message lists those it has, or if a length or mass is not above 0.
absl::StatusOr<std::unique_ptr<Environment>> MakePerturbedEnvironment(
    absl::string_view id, const Perturbation& perturbation);

}  // namespace spikeserve
