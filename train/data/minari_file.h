// Reads and writes datasets in Minari's layout (version 0.5): DIR/data/main_data.hdf5 and
// DIR/data/metadata.json, where DIR is <Minari's root>/<dataset id>.
//
// Supports episodes with one Box observation, which is flattened, and a Discrete or Box action.
// Data that Minari has no field for use its extension points: the actor is an attribute of the
// episode; labels, weights and returns-to-go are infos; environment and recipe are in the metadata.
// Not thread-safe.
#ifndef TRAIN_DATA_MINARI_FILE_H_
#define TRAIN_DATA_MINARI_FILE_H_

#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "train/data/dataset.h"

namespace spikeserve {

// Writes `dataset` to `directory`; creates the directory if needed and replaces a dataset that is
// already there. The last component of `directory` is the dataset's id, such as
// "cartpole-expert-v0". Returns INVALID_ARGUMENT unless the id ends in "-v" and a number,
// UNAVAILABLE if a file cannot be written.
absl::Status WriteMinariDataset(const Dataset& dataset, const std::string& directory);

// Returns whether `path` is a directory with the metadata file of a Minari dataset.
bool IsMinariDataset(const std::string& path);

// Reads a Minari dataset with these spaces, written by this project or by any other program. The
// environment of a foreign dataset is the id in its env_spec, or the dataset's id if it has none;
// its actor is "unknown". Errors start with the path.
absl::StatusOr<Dataset> ReadMinariDataset(const std::string& directory);

}  // namespace spikeserve

#endif  // TRAIN_DATA_MINARI_FILE_H_
