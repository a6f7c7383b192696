// The episodes that a training learns from: in memory, or in files that are larger than it.
//
// Not thread-safe if the episodes are not resident, because the HDF5 library is not. Example:
//   auto source = EpisodeSource::Open({"a-v0", "b-v0"}, /*memory=*/int64_t{1} << 30);
//   auto episodes = source->Read({0, 7});
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/types/span.h"
#include "train/data/dataset.h"
#include "train/data/minari_reader.h"

namespace spikeserve {

// What is known about an episode that is not in memory.
struct EpisodeEntry {
  size_t file = 0;  // index of its file
  int index = 0;    // of the episode in its file
  int steps = 0;
  int64_t memory = 0;  // bytes, see MemoryOf
  int weighted = 0;    // steps up to the last one with a weight
  std::string actor;
};

class EpisodeSource {
 public:
  // Holds the episodes of `dataset` in memory. REQUIRES: at least one episode.
  explicit EpisodeSource(Dataset dataset);

  // Reads all files once: datasets of Minari, or files of WriteDataset(). Keeps the episodes in
  // memory if they take at most `memory` bytes together, and releases them otherwise. Returns
  // INVALID_ARGUMENT if environments or spaces differ, or if the episodes take more and a file is
  // not a dataset of Minari, because only those can be read in parts.
  static absl::StatusOr<EpisodeSource> Open(const std::vector<std::string>& paths, int64_t memory);

  // Returns the dataset; without its episodes unless resident().
  const Dataset& dataset() const { return dataset_; }
  // Returns whether all episodes are in memory.
  bool resident() const { return files_.empty(); }
  // Returns the bytes that the episodes in memory may take. REQUIRES: !resident().
  int64_t memory() const { return memory_; }
  // Returns one entry for each episode, in the order of the files.
  const std::vector<EpisodeEntry>& entries() const { return entries_; }
  // Returns the statistics of all episodes.
  const DataStatistics& statistics() const { return statistics_; }

  // Returns the episodes with these indices, in their order. Fails if a file can no longer be read
  // or has changed.
  absl::StatusOr<std::vector<Episode>> Read(absl::Span<const int> indices) const;

 private:
  EpisodeSource(Dataset dataset, int64_t memory, DataStatistics statistics,
                std::vector<EpisodeEntry> entries, std::vector<MinariEpisodes> files);

  Dataset dataset_;
  int64_t memory_;
  DataStatistics statistics_;
  std::vector<EpisodeEntry> entries_;
  std::vector<MinariEpisodes> files_;  // empty if the episodes are resident
};

}  // namespace spikeserve
