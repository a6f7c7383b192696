// Writes datasets in Minari's layout; see minari_layout.h. Not thread-safe.
#pragma once

#include <string>

#include "absl/status/status.h"
#include "train/data/dataset.h"

namespace spikeserve {

// Writes `dataset` to `directory`; creates the directory if needed and replaces a dataset that is
// already there. The last component of `directory` is the dataset's id, such as
// "cartpole-expert-v0". Returns INVALID_ARGUMENT unless the id ends in "-v" and a number,
// UNAVAILABLE if a file cannot be written.
absl::Status WriteMinariDataset(const Dataset& dataset, const std::string& directory);

}  // namespace spikeserve
