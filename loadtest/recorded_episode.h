// Reads an episode whose observations and rewards a load test sends instead of random ones.
#pragma once

#include <string>
#include <vector>

#include "absl/status/statusor.h"

namespace spikeserve {

struct RecordedStep {
  double reward = 0.0;  // of the step before; 0 at the first one
  std::vector<float> observation;
};

// Steps in their order, with observations of equal size.
using RecordedEpisode = std::vector<RecordedStep>;

// Reads a text file with a line for each step: the reward and the numbers of the observation,
// separated by commas. Returns INVALID_ARGUMENT with the line if a line is not of that form, and
// NOT_FOUND if the file cannot be read.
absl::StatusOr<RecordedEpisode> ReadRecordedEpisode(const std::string& path);

}  // namespace spikeserve
