#include "train/data/episode_source.h"

#include <algorithm>
#include <iterator>
#include <optional>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

// Memory of the episodes that one child process reads. What it needs beside them, mostly for their
// transfer as CBOR, is several times as much.
constexpr int64_t kReadBytes = int64_t{8} << 20;

EpisodeEntry EntryOf(const Episode& episode, size_t file, int index) {
  int weighted = episode.steps();
  while (weighted > 0 && episode.weight(weighted - 1) == 0.0f) --weighted;
  return {.file = file,
          .index = index,
          .steps = episode.steps(),
          .memory = MemoryOf(episode),
          .weighted = weighted,
          .actor = episode.actor};
}

// Reads the files of EpisodeSource::Open() one after the other.
class Scan {
 public:
  explicit Scan(int64_t memory) : memory_(memory) {}

  absl::Status AddFile(const std::string& path) {
    if (IsMinariDataset(path)) return AddMinari(path);
    ASSIGN_OR_RETURN(Dataset dataset, ReadDataset(path));
    std::vector<Episode> episodes = std::exchange(dataset.episodes, {});
    files_.emplace_back(std::nullopt);
    datasets_.push_back(std::move(dataset));
    unsplittable_ = path;
    return Add(std::move(episodes));
  }

  absl::StatusOr<Dataset> TakeDataset() { return Concatenate(std::move(datasets_)); }
  DataStatistics TakeStatistics() { return *std::move(statistics_); }
  std::vector<EpisodeEntry> TakeEntries() { return std::move(entries_); }

  // Returns the files to read from later; none if the episodes are in memory.
  std::vector<MinariEpisodes> TakeFiles() {
    std::vector<MinariEpisodes> files;
    if (fits_) return files;
    for (std::optional<MinariEpisodes>& file : files_) files.push_back(*std::move(file));
    return files;
  }

 private:
  absl::Status AddMinari(const std::string& path) {
    ASSIGN_OR_RETURN(MinariEpisodes file, MinariEpisodes::Open(path));
    files_.emplace_back(std::move(file));
    const MinariEpisodes& opened = *files_.back();
    datasets_.push_back(opened.header());
    for (int first = 0; first < opened.count();) {
      ASSIGN_OR_RETURN(std::vector<Episode> episodes, opened.ReadFrom(first, kReadBytes));
      first += static_cast<int>(episodes.size());
      RETURN_IF_ERROR(Add(std::move(episodes)));
    }
    return absl::OkStatus();
  }

  // Adds episodes of the last file.
  absl::Status Add(std::vector<Episode> episodes) {
    if (!statistics_.has_value()) statistics_.emplace(datasets_[0].observation_size);
    if (datasets_.back().observation_size != datasets_[0].observation_size ||
        datasets_.back().action_space != datasets_[0].action_space) {
      // Concatenate() names what differs.
      return Concatenate(std::move(datasets_)).status();
    }
    int index = 0;
    if (!entries_.empty() && entries_.back().file == files_.size() - 1) {
      index = entries_.back().index + 1;
    }
    for (const Episode& episode : episodes) {
      entries_.push_back(EntryOf(episode, files_.size() - 1, index++));
      taken_ += entries_.back().memory;
      statistics_->Add(episode);
    }
    if (fits_ && taken_ > memory_) Release();
    if (fits_) {
      std::move(episodes.begin(), episodes.end(), std::back_inserter(datasets_.back().episodes));
    } else if (!unsplittable_.empty()) {
      return InvalidArgument(
          unsplittable_,
          absl::StrCat("datasets of Minari, because the episodes take more memory than ",
                       memory_ >> 20, " MiB"),
          "another file");
    }
    return absl::OkStatus();
  }

  void Release() {
    fits_ = false;
    for (Dataset& dataset : datasets_) dataset.episodes = {};
  }

  const int64_t memory_;
  int64_t taken_ = 0;  // bytes of all episodes so far
  bool fits_ = true;
  std::string unsplittable_;  // a file that is not a dataset of Minari; empty if there is none
  std::vector<std::optional<MinariEpisodes>> files_;
  std::vector<Dataset> datasets_;  // one for each file, with episodes while they fit
  std::vector<EpisodeEntry> entries_;
  std::optional<DataStatistics> statistics_;
};

}  // namespace

EpisodeSource::EpisodeSource(Dataset dataset)
    : dataset_(std::move(dataset)), memory_(0), statistics_(dataset_.observation_size) {
  SPIKESERVE_DCHECK(!dataset_.episodes.empty());
  for (const Episode& episode : dataset_.episodes) {
    entries_.push_back(EntryOf(episode, 0, static_cast<int>(entries_.size())));
    statistics_.Add(episode);
  }
}

EpisodeSource::EpisodeSource(Dataset dataset, int64_t memory, DataStatistics statistics,
                             std::vector<EpisodeEntry> entries, std::vector<MinariEpisodes> files)
    : dataset_(std::move(dataset)),
      memory_(memory),
      statistics_(std::move(statistics)),
      entries_(std::move(entries)),
      files_(std::move(files)) {}

absl::StatusOr<EpisodeSource> EpisodeSource::Open(const std::vector<std::string>& paths,
                                                  int64_t memory) {
  Scan scan(memory);
  for (const std::string& path : paths) {
    RETURN_IF_ERROR(scan.AddFile(path));
  }
  ASSIGN_OR_RETURN(Dataset dataset, scan.TakeDataset());
  return EpisodeSource(std::move(dataset), memory, scan.TakeStatistics(), scan.TakeEntries(),
                       scan.TakeFiles());
}

absl::StatusOr<std::vector<Episode>> EpisodeSource::Read(absl::Span<const int> indices) const {
  std::vector<Episode> episodes;
  if (resident()) {
    for (const int i : indices) episodes.push_back(dataset_.episodes[i]);
    return episodes;
  }
  for (size_t begin = 0; begin < indices.size();) {
    const size_t file = entries_[indices[begin]].file;
    std::vector<int> of_file;
    int64_t bytes = 0;
    while (begin < indices.size() && entries_[indices[begin]].file == file && bytes < kReadBytes) {
      const EpisodeEntry& entry = entries_[indices[begin++]];
      of_file.push_back(entry.index);
      bytes += entry.memory;
    }
    ASSIGN_OR_RETURN(std::vector<Episode> read, files_[file].Read(of_file));
    std::move(read.begin(), read.end(), std::back_inserter(episodes));
  }
  for (size_t i = 0; i < indices.size(); ++i) {
    const int expected = entries_[indices[i]].steps;
    if (episodes[i].steps() == expected) continue;
    return InvalidArgument(
        "data", absl::StrCat("an episode of ", expected, " steps, as when it was first read"),
        episodes[i].steps());
  }
  return episodes;
}

}  // namespace spikeserve
