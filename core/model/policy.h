// Defines a policy: a model with its weights, and the constants that connect it to its environment.
//
// Immutable once built, and shared as std::shared_ptr<const Policy>, so that replacing a policy
// never waits for a reader.
#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "core/action/action_space.h"
#include "core/model/config.h"
#include "core/model/features.h"
#include "core/model/weights.h"

namespace spikeserve {

struct WiringModel;

struct Policy {
  ModelConfig config;
  ActionSpace action_space;
  Weights weights;

  // The return token's input is (G - return_offset) / return_scale.
  float return_offset = 0.0f;
  float return_scale = 1.0f;
  float target_return = 0.0f;   // G_0 of sessions that set no other
  float modulator_mean = 0.0f;  // mu and sigma of eq. 4.2
  float modulator_std = 1.0f;

  std::string environment;                    // Gymnasium id, for example "CartPole-v1"
  std::string training = "{}";                // JSON object: command, seed, data recipe, evaluation
  Features features;                          // names of the elements; may be empty
  std::shared_ptr<const WiringModel> wiring;  // checks sessions (wiring_model.h); null: none

  int observation_size() const { return static_cast<int>(weights.observation_mean.values.size()); }

  // Returns INVALID_ARGUMENT unless the config and the action space are valid, every tensor has the
  // shape that they require, every number is finite and in its range (see integer_weights.h for
  // integers), the scales and deviations are positive, the environment is printable, `training` is
  // a JSON object, and the features and the wiring model fit the sizes.
  absl::Status Validate() const;
};

// Returns a policy with random weights:
// - query, key, value and FFN-in of a spiking model: normal with deviation 0.3/sqrt(fan-in),
//   bias 0.1
// - coders: gain 0.5, bias 0.2
// - phase: omega uniform in [0.1, 10), phi uniform in [0, 2 pi)
// - attention scale c_h: 1/sqrt(d_h)
// - norms: weight 1, bias 0
// - observation: mean 0, deviations 1
// - everything else: uniform in [-1/sqrt(fan-in), 1/sqrt(fan-in))
//
// Equal seeds give equal policies on every machine, because every number is a function of seed,
// tensor name and index in integer arithmetic. REQUIRES: a valid config with Arithmetic::kFloat32,
// a valid action space, observation_size >= 1. Quantize (quantize.h) makes an integer policy of it.
Policy RandomPolicy(const ModelConfig& config, int observation_size,
                    const ActionSpace& action_space, uint64_t seed);

// Returns the mean return of the evaluation after training, which is stored as
// `evaluation.mean_return` in `training`, or nullopt if it is not stored.
std::optional<double> TrainingReturn(const Policy& policy);

}  // namespace spikeserve
