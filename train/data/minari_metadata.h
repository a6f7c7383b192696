// Parses the metadata of datasets in Minari's layout; see minari_layout.h. Pure functions; safe to
// call from many threads.
#pragma once

#include <cstdint>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "core/dataset/dataset.h"

namespace spikeserve {

// How the indices of Discrete and MultiDiscrete actions are stored.
struct IndexLayout {
  std::vector<int64_t> counts;  // number of indices of each element; empty for a Box
  std::vector<int64_t> starts;  // first index of each element
};

// The contents of a dataset's metadata.json.
struct MinariMetadata {
  Dataset dataset;  // without its episodes
  int episodes = 0;
  IndexLayout indices;
};

// Parses the text of metadata.json. INVALID_ARGUMENT names what minari_layout.h does not support.
absl::StatusOr<MinariMetadata> ParseMinariMetadata(absl::string_view text);

}  // namespace spikeserve
