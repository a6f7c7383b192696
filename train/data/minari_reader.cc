#include "train/data/minari_reader.h"

#include <algorithm>
#include <filesystem>
#include <system_error>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/base/file.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "train/data/child_reader.h"
#include "train/data/hdf5_file.h"
#include "train/data/minari_layout.h"
#include "train/data/minari_metadata.h"

namespace spikeserve {
namespace {

class Reader {
 public:
  Reader(const Hdf5File& file, const IndexLayout& indices, Dataset* dataset)
      : file_(file), space_(indices), dataset_(*dataset) {}

  // Appends the episode with this index to the dataset.
  absl::Status Read(int index) {
    const std::string group = absl::StrCat("episode_", index);
    Episode episode;
    ASSIGN_OR_RETURN(const auto observations, file_.Read<float>(group + "/observations"));
    episode.observations = observations.values;
    ASSIGN_OR_RETURN(const auto rewards, file_.Read<double>(group + "/rewards"));
    episode.rewards = rewards.values;
    if (auto status = ReadActions(group + "/actions", &episode.actions); !status.ok()) {
      return status;
    }
    for (const auto& [name, ended] : {std::pair{"/terminations", &episode.terminated},
                                      std::pair{"/truncations", &episode.truncated}}) {
      ASSIGN_OR_RETURN(const auto values, file_.ReadBools(group + name));
      RETURN_IF_ERROR(CheckEnds(group + name, values, episode.actions.size()));
      *ended = !values.empty() && values.back();
    }
    RETURN_IF_ERROR(ReadInfos(group + "/infos", &episode));
    episode.actor = file_.ReadString(group, "actor").value_or("unknown");
    episode.seed = static_cast<uint64_t>(file_.ReadInteger(group, "seed").value_or(0));
    if (const auto asked = file_.ReadDouble(group, "asked_return"); asked.ok()) {
      episode.target_return = *asked;
    }
    if (auto status = AcceptEpisode(dataset_, &episode); !status.ok()) {
      return Annotate(status, group);
    }
    dataset_.episodes.push_back(std::move(episode));
    return absl::OkStatus();
  }

 private:
  absl::Status ReadActions(const std::string& name, std::vector<Action>* actions) {
    if (dataset_.action_space.is_discrete()) return ReadIndices(name, actions);
    ASSIGN_OR_RETURN(const auto values, file_.Read<float>(name));
    const int64_t columns = values.shape.columns.value_or(1);
    if (auto status = CheckColumns(name, dataset_.action_space.size(), columns); !status.ok()) {
      return status;
    }
    for (int64_t row = 0; row < values.shape.rows; ++row) {
      const auto begin = values.values.begin() + row * columns;
      actions->push_back({.discrete = 0, .continuous = {begin, begin + columns}});
    }
    return absl::OkStatus();
  }

  // Reads one index an action, or one for each element of a MultiDiscrete, which become the index
  // of their combination: the last element changes fastest.
  absl::Status ReadIndices(const std::string& name, std::vector<Action>* actions) {
    ASSIGN_OR_RETURN(const auto values, file_.Read<int64_t>(name));
    const auto elements = static_cast<int64_t>(space_.counts.size());
    if (auto status = CheckColumns(name, elements, values.shape.columns.value_or(1));
        !status.ok()) {
      return status;
    }
    for (int64_t row = 0; row < values.shape.rows; ++row) {
      int64_t joint = 0;
      for (int64_t i = 0; i < elements; ++i) {
        const int64_t index = values.values[row * elements + i];
        const int64_t last = space_.starts[i] + space_.counts[i] - 1;
        if (index < space_.starts[i] || index > last) {
          return InvalidArgument(name, absl::StrCat(space_.starts[i], " to ", last),
                                 absl::StrCat(index, " at step ", row));
        }
        joint = joint * space_.counts[i] + index - space_.starts[i];
      }
      actions->push_back({.discrete = static_cast<int>(joint), .continuous = {}});
    }
    return absl::OkStatus();
  }

  // Returns INVALID_ARGUMENT if an episode ends before its last step.
  static absl::Status CheckEnds(const std::string& name, const std::vector<bool>& ends,
                                size_t steps) {
    if (ends.size() != steps) {
      return InvalidArgument(name, absl::StrCat(steps, " values"), ends.size());
    }
    const auto first = std::find(ends.begin(), ends.end(), true);
    if (first == ends.end() || first + 1 == ends.end()) return absl::OkStatus();
    return absl::InvalidArgumentError(absl::StrCat(name, ": step ", first - ends.begin(),
                                                   ": expected true only at the last step, "
                                                   "received true"));
  }

  static absl::Status CheckColumns(const std::string& name, int64_t expected, int64_t received) {
    if (expected == received) return absl::OkStatus();
    return InvalidArgument(name, absl::StrCat(expected, " values an action"), received);
  }

  // Infos belong to observations, so there may be one more than actions.
  absl::Status ReadInfos(const std::string& group, Episode* episode) {
    const size_t steps = episode->actions.size();
    if (file_.Exists(group + "/label")) {
      if (auto status = ReadActions(group + "/label", &episode->labels); !status.ok()) {
        return status;
      }
      if (auto status = TrimInfos(group + "/label", steps, &episode->labels); !status.ok()) {
        return status;
      }
    }
    if (!file_.Exists(group + "/weight")) return absl::OkStatus();
    ASSIGN_OR_RETURN(const auto weights, file_.Read<float>(group + "/weight"));
    episode->weights = weights.values;
    return TrimInfos(group + "/weight", steps, &episode->weights);
  }

  template <typename T>
  static absl::Status TrimInfos(const std::string& name, size_t steps, std::vector<T>* infos) {
    if (infos->size() != steps && infos->size() != steps + 1) {
      return InvalidArgument(name, absl::StrCat(steps, " or ", steps + 1, " rows"), infos->size());
    }
    infos->resize(steps);
    return absl::OkStatus();
  }

  const Hdf5File& file_;
  const IndexLayout& space_;
  Dataset& dataset_;
};

absl::StatusOr<MinariMetadata> ReadMetadata(const std::string& directory) {
  ASSIGN_OR_RETURN(const auto text, ReadFile(directory + kMinariMetadata));
  absl::StatusOr<MinariMetadata> metadata = ParseMinariMetadata(text);
  if (metadata.ok() && metadata->episodes == 0) {
    return InvalidArgument("total_episodes", "at least 1", "0");
  }
  return metadata;
}

// Returns the index of the next episode to read after those in `read`, or -1 after the last one.
using NextIndex = absl::FunctionRef<int(const std::vector<Episode>& read)>;

absl::StatusOr<Dataset> ReadEpisodes(const std::string& directory, const MinariMetadata& metadata,
                                     NextIndex next) {
  ASSIGN_OR_RETURN(const Hdf5File file, Hdf5File::Open(directory + kMinariData));
  Dataset dataset = metadata.dataset;
  Reader reader(file, metadata.indices, &dataset);
  for (int i = next(dataset.episodes); i >= 0; i = next(dataset.episodes)) {
    RETURN_IF_ERROR(reader.Read(i));
  }
  return dataset;
}

}  // namespace

bool IsMinariDataset(const std::string& path) {
  std::error_code error;
  return std::filesystem::exists(path + kMinariMetadata, error);
}

absl::StatusOr<MinariEpisodes> MinariEpisodes::Open(const std::string& directory) {
  absl::StatusOr<MinariMetadata> metadata = ReadMetadata(directory);
  if (!metadata.ok()) return Annotate(metadata.status(), directory);
  return MinariEpisodes(directory, *std::move(metadata));
}

absl::StatusOr<std::vector<Episode>> MinariEpisodes::ReadFrom(int first, int64_t bytes) const {
  SPIKESERVE_DCHECK(first >= 0 && first < count());
  int64_t taken = 0;
  return ReadWhile([&, first](const std::vector<Episode>& read) {
    if (!read.empty()) taken += MemoryOf(read.back());
    const int next = first + static_cast<int>(read.size());
    return next < count() && (read.empty() || taken < bytes) ? next : -1;
  });
}

absl::StatusOr<std::vector<Episode>> MinariEpisodes::Read(absl::Span<const int> indices) const {
  SPIKESERVE_DCHECK(!indices.empty());
  return ReadWhile([&](const std::vector<Episode>& read) {
    return read.size() < indices.size() ? indices[read.size()] : -1;
  });
}

absl::StatusOr<std::vector<Episode>> MinariEpisodes::ReadWhile(NextIndex next) const {
  absl::StatusOr<Dataset> dataset =
      ReadInChild([&] { return ReadEpisodes(directory_, metadata_, next); });
  if (!dataset.ok()) return Annotate(dataset.status(), directory_);
  return std::move(dataset->episodes);
}

}  // namespace spikeserve
