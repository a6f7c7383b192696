// The files a server leaves in --record_dir: DIR/<recording>/<episode>.cbor, one dataset of one
// episode each. A recording is a session.
//
// Free functions; safe to call from many threads.
#ifndef CORE_DATASET_RECORDINGS_H_
#define CORE_DATASET_RECORDINGS_H_

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "core/dataset/dataset.h"

namespace spikeserve {

// Names sort as the episodes follow each other.
std::string RecordingPath(absl::string_view directory, absl::string_view recording,
                          int64_t episode);

// The episodes in `path`: one file, one recording, or a whole directory of them; in the order of
// their names, one dataset each. With an `environment`, only those of it. NOT_FOUND if there is
// none.
absl::StatusOr<std::vector<Dataset>> ReadRecordings(const std::string& path,
                                                    absl::string_view environment = "");

}  // namespace spikeserve

#endif  // CORE_DATASET_RECORDINGS_H_
