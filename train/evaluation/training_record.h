// Stores how a policy came to be: the JSON object `training` of a policy file. It names the command
// and the commit of its program, and identifies the files that the command read by their SHA-256:
// the initial policy or the policy that was rounded (`parent_sha256`), the datasets
// (`data_sha256`, by path) and, in the recipe of a dataset, the student that played for it.
//
// All functions are pure or read one file, and are thread-safe.
#pragma once

#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "nlohmann/json.hpp"

namespace spikeserve {

// Adds `lineage` to `record`: the lineage of `earlier`, followed by `earlier` itself. `earlier` is
// the record of the policy that this one was made from; without one ("{}"), does nothing.
void AddLineage(const std::string& earlier, nlohmann::ordered_json* record);

// Returns the commit of the source tree that this program was built from, 40 hexadecimal digits,
// with "-dirty" appended if tracked files differed from it, or "unknown" without git.
std::string BuildCommit();

// Returns the SHA-256 of a file's bytes as 64 hexadecimal digits. NOT_FOUND if there is no such
// file.
absl::StatusOr<std::string> FileSha256(const std::string& path);

// Returns the identities of a command's sources: the commit of this program, and the SHA-256 of the
// policy that it starts from (empty: none) and of its datasets. NOT_FOUND if a file does not exist.
// To be called first: until a training ends, the files may change.
absl::StatusOr<nlohmann::ordered_json> IdentifySources(const std::string& parent,
                                                       const std::vector<std::string>& data);

// Returns the words that identify the files of `sources`, which IdentifySources() has returned, in
// the checkpoints of a run, each after a space. Without paths: a file that was moved is the same.
std::string SourceWords(const nlohmann::ordered_json& sources);

}  // namespace spikeserve
