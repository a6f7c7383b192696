#include <algorithm>
#include <memory>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/environment/environment.h"
#include "train/data/clip_sampler.h"
#include "train/recording/policy_player.h"
#include "train/train_run.h"

namespace spikeserve {
namespace {

// Returns INVALID_ARGUMENT if an environment of this program has other spaces than its data.
absl::Status CheckEnvironment(const Dataset& dataset) {
  const absl::StatusOr<std::unique_ptr<Environment>> made = MakeEnvironment(dataset.environment);
  if (!made.ok()) return absl::OkStatus();  // one of another program
  return CheckSpacesMatch(**made, dataset);
}

// Returns INVALID_ARGUMENT if no episode is long enough for a decision to be executed.
absl::Status CheckDelay(DelayRange delay, const EpisodeSource& source) {
  int longest = 0;
  for (const EpisodeEntry& entry : source.entries()) longest = std::max(longest, entry.steps);
  if (delay.most < longest) return absl::OkStatus();
  return InvalidArgument(
      "--delay", absl::StrCat("fewer steps than the longest episode has, ", longest), delay.most);
}

}  // namespace

absl::StatusOr<EpisodeSource> MakeSource(const TrainFlags& flags) {
  if (flags.data.empty()) {
    RETURN_IF_ERROR(MakeOutDirectory(flags.out));
    RecordFlags record = flags.record;
    record.options.seed = flags.trainer.options.seed;
    record.options.expert.environment = flags.env.value_or(record.options.expert.environment);
    ASSIGN_OR_RETURN(Dataset recorded, RecordFromFlags(record, flags.out));
    return EpisodeSource(std::move(recorded));
  }
  absl::StatusOr<EpisodeSource> source =
      EpisodeSource::Open(flags.data, int64_t{flags.data_memory} << 20);
  if (!source.ok()) return source;
  const std::string expected = source->dataset().environment;
  const std::string environment = flags.env.value_or(expected);
  if (environment != expected) {
    return InvalidArgument("--env", absl::StrCat(expected, " as in --data"), environment);
  }
  RETURN_IF_ERROR(CheckEnvironment(source->dataset()));
  return source;
}

absl::Status CheckSource(const TrainOptions& options, const EpisodeSource& source) {
  RETURN_IF_ERROR(CheckDelay(options.delay, source));
  const Split split = SplitEpisodes(source.entries(), options.validation);
  const bool weighted = std::any_of(split.training.begin(), split.training.end(), [&](int index) {
    return source.entries()[static_cast<size_t>(index)].weighted > options.delay.least;
  });
  if (weighted) return absl::OkStatus();
  return absl::InvalidArgumentError(
      "--data: weights: expected one above 0 in the episodes for training, received only 0");
}

}  // namespace spikeserve
