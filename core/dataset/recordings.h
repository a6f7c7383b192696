// Finds the files that a server writes to --record_dir: DIR/<recording>/<episode>.cbor. A recording
// holds the episodes of one session; each file is a dataset of one episode.
//
// All functions are thread-safe.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "core/dataset/dataset.h"

namespace spikeserve {

// Returns the path of one episode's file. File names sort in the order of the episodes.
std::string RecordingPath(absl::string_view directory, absl::string_view recording,
                          int64_t episode);

// Reads the episodes under `path`, which is a file, a recording or a directory of recordings.
// Returns one dataset per file, sorted by file name. Skips the datasets of other environments if
// `environment` is not empty. NOT_FOUND if no dataset is left.
absl::StatusOr<std::vector<Dataset>> ReadRecordings(const std::string& path,
                                                    absl::string_view environment = "");

}  // namespace spikeserve
