// Datasets in Minari's layout (0.5): DIR/data/main_data.hdf5 and DIR/data/metadata.json, where DIR
// is <Minari's root>/<dataset id>.
//
// Written and read are episodes of one Box observation (flattened) and a Discrete or Box action.
// What Minari does not know is kept where it lets others keep things: who acted as attributes of
// an episode, labels, weights and return-to-go as infos, environment and recipe as metadata. Not
// thread-safe.
#ifndef TRAIN_DATA_MINARI_FILE_H_
#define TRAIN_DATA_MINARI_FILE_H_

#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "train/data/dataset.h"

namespace spikeserve {

// Makes `directory` if need be and replaces what it holds. Its last component is the dataset's id,
// such as "cartpole-expert-v0": INVALID_ARGUMENT unless it ends in -v and a number.
absl::Status WriteMinariDataset(const Dataset& dataset, const std::string& directory);

// Whether `path` is a directory that looks like a Minari dataset.
bool IsMinariDataset(const std::string& path);

// Any Minari dataset of such spaces, ours or not; one from elsewhere has the environment of its
// env_spec, or else its id, and the actor "unknown". Errors start with the path.
absl::StatusOr<Dataset> ReadMinariDataset(const std::string& directory);

}  // namespace spikeserve

#endif  // TRAIN_DATA_MINARI_FILE_H_
