// Measures what `spiketrain quantize --to=integer` needs to know about a policy: the ranges of its
// inputs and of its residual stream, which decide their fraction bits, and the hidden neurons that
// fire.
//
// All functions are thread-safe.
#pragma once

#include <cstdint>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/types/span.h"
#include "core/dataset/dataset.h"
#include "core/model/policy.h"

namespace spikeserve {

// Episodes that calibration plays, from this seed on, if there are no recorded ones.
inline constexpr int kCalibrationEpisodes = 200;
inline constexpr uint64_t kCalibrationSeed = 1'500'000;

// Plays the calibration episodes in the policy's environment. NOT_FOUND for an unknown environment.
absl::StatusOr<std::vector<Episode>> PlayCalibrationEpisodes(const Policy& policy);

// Returns the largest magnitude of a standardised observation or return-to-go of the episodes, at
// least 1, the largest one of an encoded action. INVALID_ARGUMENT if there is no episode, or if the
// observations have another size than the policy's.
absl::StatusOr<float> LargestInput(const Policy& policy, absl::Span<const Episode> episodes);

// Returns the largest magnitude of the residual stream in the episodes, which the policy observes
// without acting. REQUIRES: a policy with spikes in float32, and episodes of its spaces.
float LargestResidual(const Policy& policy, absl::Span<const Episode> episodes);

// Returns which hidden neurons [L][F] fire in any of the episodes, which the policy observes
// without acting. REQUIRES: a policy with Arithmetic::kInteger and spikes, and episodes of its
// spaces.
std::vector<std::vector<bool>> FiringHiddenNeurons(const Policy& policy,
                                                   absl::Span<const Episode> episodes);

}  // namespace spikeserve
