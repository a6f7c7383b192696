// Verdicts about recorded episodes that came after their ends. The recording stays as it is; each
// verdict is one more line, in JSON, of a file beside it: 000003.amendments for 000003.cbor.
//
//   ASSIGN_OR_RETURN(auto given, ReadAmendments(path, &dataset));  // and applies them
//   RETURN_IF_ERROR(WriteAmendments(path, given));
//
// Thread-safe on distinct files.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/dataset/dataset.h"

namespace spikeserve {

struct EpisodeAmendment {
  std::string id;                    // unique for the episode
  std::string digest = {};           // of all that it says
  std::string author = {};           // who judged
  std::string time = {};             // RFC 3339
  std::vector<double> rewards = {};  // [steps], in place of those received; empty: as received
  std::optional<double> reward = std::nullopt;  // added to the last one
  std::optional<bool> success = std::nullopt;
  std::string label = {};
};

// Reads the amendments of the recording at `path`, oldest first, and applies them to its episode:
// of those with rewards the last one, relative to what was received, and the last success and
// label. Returns none if there is no file of them. INVALID_ARGUMENT if one does not fit, NOT_FOUND
// if the file is there and cannot be read; messages start with its path.
absl::StatusOr<std::vector<EpisodeAmendment>> ReadAmendments(const std::string& path,
                                                             Dataset* dataset);

// Applies one of them, as above. INVALID_ARGUMENT if the number of rewards is not that of the
// steps. REQUIRES: a dataset of one served episode.
absl::Status ApplyAmendment(const EpisodeAmendment& amendment, Dataset* dataset);

// Returns the line of one of them.
std::string AmendmentLine(const EpisodeAmendment& amendment);

// Replaces the file of the amendments of the recording at `path`.
absl::Status WriteAmendments(const std::string& path,
                             const std::vector<EpisodeAmendment>& amendments);

}  // namespace spikeserve
