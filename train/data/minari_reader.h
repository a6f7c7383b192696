// Reads datasets in Minari's layout; see minari_layout.h. Not thread-safe.
//
// Reads in a child process, so that a damaged or hostile file that makes the HDF5 library crash,
// run without end or take all memory is an error, too. Errors start with the path; INVALID_ARGUMENT
// names what minari_layout.h does not support.
#pragma once

#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "absl/functional/function_ref.h"
#include "absl/status/statusor.h"
#include "absl/types/span.h"
#include "train/data/dataset.h"
#include "train/data/minari_metadata.h"

namespace spikeserve {

// Returns whether `path` is a directory with the metadata file of a Minari dataset.
bool IsMinariDataset(const std::string& path);

// Reads the episodes of one dataset in parts, so that not all of them have to be in memory. Any
// program may have written it. The environment of a foreign dataset is the id in its env_spec, or
// the dataset's id if it has none; its actor is "unknown".
class MinariEpisodes {
 public:
  // Reads the metadata.
  static absl::StatusOr<MinariEpisodes> Open(const std::string& directory);

  // Returns the dataset without its episodes.
  const Dataset& header() const { return metadata_.dataset; }
  int count() const { return metadata_.episodes; }

  // Reads episodes from index `first` on, until they take `bytes` of memory or the last one is
  // read. Reads at least one. REQUIRES: 0 <= first < count().
  absl::StatusOr<std::vector<Episode>> ReadFrom(int first, int64_t bytes) const;
  // Reads the episodes with these indices, in their order. REQUIRES: at least one index, and
  // indices from 0 to count() - 1.
  absl::StatusOr<std::vector<Episode>> Read(absl::Span<const int> indices) const;

 private:
  MinariEpisodes(std::string directory, MinariMetadata metadata)
      : directory_(std::move(directory)), metadata_(std::move(metadata)) {}

  // Calls `next` for indices until it returns -1, and reads the episodes with these indices.
  absl::StatusOr<std::vector<Episode>> ReadWhile(
      absl::FunctionRef<int(const std::vector<Episode>& read)> next) const;

  std::string directory_;
  MinariMetadata metadata_;
};

}  // namespace spikeserve
