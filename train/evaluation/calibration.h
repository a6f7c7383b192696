// Finds the range of a policy's inputs, from which `spiketrain quantize --to=integer` chooses the
// fraction bits of the inputs.
//
// All functions are thread-safe.
#ifndef TRAIN_EVALUATION_CALIBRATION_H_
#define TRAIN_EVALUATION_CALIBRATION_H_

#include <cstdint>

#include "absl/status/statusor.h"
#include "absl/types/span.h"
#include "core/dataset/dataset.h"
#include "core/model/policy.h"

namespace spikeserve {

// Episodes that calibration plays, from this seed on, if there are no recorded ones.
inline constexpr int kCalibrationEpisodes = 20;
inline constexpr uint64_t kCalibrationSeed = 1'500'000;

// Returns the largest magnitude of a standardised observation or return-to-go of the episodes, at
// least 1, the largest one of an encoded action. INVALID_ARGUMENT if there is no episode, or if the
// observations have another size than the policy's.
absl::StatusOr<float> LargestInput(const Policy& policy, absl::Span<const Episode> episodes);

// As above for the episodes that the policy plays in its environment. NOT_FOUND for an unknown
// environment.
absl::StatusOr<float> LargestPlayedInput(const Policy& policy);

}  // namespace spikeserve

#endif  // TRAIN_EVALUATION_CALIBRATION_H_
