// Reads datasets in Minari's layout; see minari_layout.h. Not thread-safe.
#ifndef TRAIN_DATA_MINARI_READER_H_
#define TRAIN_DATA_MINARI_READER_H_

#include <string>

#include "absl/status/statusor.h"
#include "train/data/dataset.h"

namespace spikeserve {

// Returns whether `path` is a directory with the metadata file of a Minari dataset.
bool IsMinariDataset(const std::string& path);

// Reads a Minari dataset, written by this project or by any other program. INVALID_ARGUMENT names
// what minari_layout.h does not support. The environment of a foreign dataset is the id in its
// env_spec, or the dataset's id if it has none; its actor is "unknown". Errors start with the path.
// Reads in a child process, so that a damaged or hostile file that makes the HDF5 library crash,
// run without end or take all memory is an error, too.
absl::StatusOr<Dataset> ReadMinariDataset(const std::string& directory);

}  // namespace spikeserve

#endif  // TRAIN_DATA_MINARI_READER_H_
