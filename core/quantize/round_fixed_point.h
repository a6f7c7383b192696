// Rounds the parts of a float32 policy to those of integer arithmetic (fixed_point_weights.h).
//
// Functions that return a status fail with INVALID_ARGUMENT, which names the tensor and the bound,
// if a number is too large. All functions are pure and thread-safe.
#pragma once

#include <string>

#include "absl/status/status.h"
#include "core/math/tensor.h"
#include "core/model/fixed_point_weights.h"
#include "core/model/integer_weights.h"
#include "core/model/weights.h"

namespace spikeserve {

// Returns the largest number of fraction bits, 1 to 12, with which `largest` fits a residual.
int FractionFor(double largest);

// Returns the largest sum of an embedding for usual inputs.
double LargestEmbedded(const Linear& linear);

// Sets `rounded` to the values with `fraction` fraction bits.
absl::Status RoundNumbers(const std::string& name, const Tensor& values, int fraction,
                          Int16Tensor* rounded);

// Rounds a map whose inputs and outputs have the given fraction bits. Weights are first multiplied
// by `factor`.
absl::Status RoundMap(const std::string& name, const Linear& linear, double factor,
                      int input_fraction, int output_fraction, FixedPointMap* map);

// Rounds a norm whose outputs have `fraction` fraction bits.
absl::Status RoundNorm(const std::string& name, const Norm& norm, int fraction,
                       FixedPointNorm* rounded);

// Rounds the map `linear` into a population (integer_weights.h). INVALID_ARGUMENT if 16 bits cannot
// hold a bias or threshold. The message names the tensor, of which `name` is the prefix.
absl::Status RoundPopulation(const std::string& name, const Linear& linear, float threshold,
                             IntegerPopulation* population);

}  // namespace spikeserve
