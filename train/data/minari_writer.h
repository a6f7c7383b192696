// Writes datasets in Minari's layout; see minari_layout.h. Not thread-safe.
#pragma once

#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "train/data/dataset.h"

namespace spikeserve {

// Returns the id of a dataset in `directory`, which is its last component, such as
// "cartpole-expert-v0". INVALID_ARGUMENT unless it ends in "-v" and a number.
absl::StatusOr<std::string> MinariId(const std::string& directory);

// Writes `dataset` to `directory`; creates the directory if needed and replaces a dataset that is
// already there. Returns an error of MinariId(), or UNAVAILABLE if a file cannot be written.
absl::Status WriteMinariDataset(const Dataset& dataset, const std::string& directory);

}  // namespace spikeserve
