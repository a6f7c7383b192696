#include "loadtest/recorded_episode.h"

#include <fstream>
#include <utility>

#include "absl/status/status.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "core/base/status.h"

namespace spikeserve {
namespace {

// Returns false if `line` is not a reward and an observation.
bool ParseStep(absl::string_view line, RecordedStep* step) {
  const std::vector<absl::string_view> numbers = absl::StrSplit(line, ',');
  if (numbers.size() < 2 || !absl::SimpleAtod(numbers[0], &step->reward)) return false;
  step->observation.resize(numbers.size() - 1);
  for (size_t k = 1; k < numbers.size(); ++k) {
    if (!absl::SimpleAtof(numbers[k], &step->observation[k - 1])) return false;
  }
  return true;
}

}  // namespace

absl::StatusOr<RecordedEpisode> ReadRecordedEpisode(const std::string& path) {
  std::ifstream file(path);
  if (!file) return absl::NotFoundError(absl::StrCat(path, ": expected a file that can be read"));
  RecordedEpisode episode;
  for (std::string line; std::getline(file, line);) {
    RecordedStep step;
    if (!ParseStep(line, &step) ||
        (!episode.empty() && step.observation.size() != episode[0].observation.size())) {
      return absl::InvalidArgumentError(
          absl::StrCat(path, ":", episode.size() + 1,
                       ": expected a reward and an observation of equal size in each line, "
                       "separated by commas, received \"",
                       line, "\""));
    }
    episode.push_back(std::move(step));
  }
  if (!episode.empty()) return episode;
  return InvalidArgument(path, "a line", "none");
}

}  // namespace spikeserve
