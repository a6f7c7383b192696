// Stores how a policy came to be: the JSON object `training` of a policy file.
//
// All functions are pure or read one file, and are thread-safe.
#ifndef TRAIN_EVALUATION_TRAINING_RECORD_H_
#define TRAIN_EVALUATION_TRAINING_RECORD_H_

#include <string>

#include "absl/status/statusor.h"
#include "nlohmann/json.hpp"

namespace spikeserve {

// Adds `lineage` to `record`: the lineage of `earlier`, followed by `earlier` itself. `earlier` is
// the record of the policy that this one was made from; without one ("{}"), does nothing.
void AddLineage(const std::string& earlier, nlohmann::ordered_json* record);

// Returns the SHA-256 of a file's bytes as 64 hexadecimal digits. NOT_FOUND if there is no such
// file.
absl::StatusOr<std::string> FileSha256(const std::string& path);

}  // namespace spikeserve

#endif  // TRAIN_EVALUATION_TRAINING_RECORD_H_
