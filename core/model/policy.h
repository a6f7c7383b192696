// A policy: a model with its weights, and what is needed to talk to its environment.
//
// Immutable once built and shared as std::shared_ptr<const Policy>, so that a swap never waits for
// a reader.
#ifndef CORE_MODEL_POLICY_H_
#define CORE_MODEL_POLICY_H_

#include <cstdint>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "core/action/action_space.h"
#include "core/model/config.h"
#include "core/model/weights.h"

namespace spikeserve {

struct Policy {
  ModelConfig config;
  ActionSpace action_space;
  Weights weights;

  float return_offset = 0.0f;  // the return token's input is (G - return_offset) / return_scale
  float return_scale = 1.0f;
  float target_return = 0.0f;   // G_0 unless a session asks for another
  float modulator_mean = 0.0f;  // mu and sigma of eq. 4.2
  float modulator_std = 1.0f;

  std::string environment;      // Gymnasium's id, for example "CartPole-v1"
  std::string training = "{}";  // JSON object: command, seed, data recipe, evaluation

  int observation_size() const { return static_cast<int>(weights.observation_mean.values.size()); }

  // INVALID_ARGUMENT unless config and action space are valid, every tensor has the shape they call
  // for, every number is finite, the scales and deviations are positive, and `training` is a JSON
  // object.
  absl::Status Validate() const;
};

// A policy with random weights (QKV and FFN-in normal with deviation 0.3/sqrt(fan-in), bias 0.1;
// coders 0.5 and 0.2; omega in U(0.1, 10), phi in U(0, 2 pi); c_h 1/sqrt(d_h); norms 1 and 0; the
// rest, and QKV and FFN-in of a dense model, U(+-1/sqrt(fan-in))), observations standardised by
// mean 0 and deviation 1. The same seed gives the same policy on every machine: every number is a
// function of seed, tensor name and index by integer arithmetic. REQUIRES: a valid config and
// action space, observation_size >= 1.
Policy RandomPolicy(const ModelConfig& config, int observation_size,
                    const ActionSpace& action_space, uint64_t seed);

// The mean return of the evaluation stored in the policy, `evaluation.mean_return` of `training`;
// nothing if it has none.
std::optional<double> TrainingReturn(const Policy& policy);

}  // namespace spikeserve

#endif  // CORE_MODEL_POLICY_H_
