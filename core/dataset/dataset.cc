#include "core/dataset/dataset.h"

#include <iterator>
#include <tuple>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/types/span.h"
#include "core/base/file.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "core/dataset/dataset_cbor.h"

namespace spikeserve {

using Json = nlohmann::json;

namespace {

absl::Status CheckServed(const Dataset& dataset, const ServedEpisode& served, size_t steps) {
  const size_t n = dataset.action_space.is_discrete() ? dataset.action_space.n : 0;
  const std::tuple<const char*, size_t, size_t> lengths[] = {
      {"returns_to_go", served.returns_to_go.size(), steps},
      {"probabilities", served.probabilities.size(), steps * n},
      {"spikes", served.spikes.size(), steps}};
  for (const auto& [field, length, expected] : lengths) {
    if (length == expected) continue;
    return absl::InvalidArgumentError(
        absl::StrCat("served.", field, ": expected ", expected, ", received ", length));
  }
  if (!served.answered_actions.empty() && served.answered_actions.size() != steps) {
    return absl::InvalidArgumentError(absl::StrCat("served.answered_actions: expected ", steps,
                                                   " or none, received ",
                                                   served.answered_actions.size()));
  }
  for (const Action& action : served.answered_actions) {
    RETURN_IF_ERROR(dataset.action_space.Contains(action));
  }
  return absl::OkStatus();
}

}  // namespace

absl::Status CheckEpisode(const Dataset& dataset, const Episode& episode) {
  const size_t steps = episode.actions.size();
  if (steps == 0)
    return absl::InvalidArgumentError("actions: expected at least one, received none");
  if (episode.rewards.size() != steps) {
    return absl::InvalidArgumentError(
        absl::StrCat("rewards: expected ", steps, ", received ", episode.rewards.size()));
  }
  const size_t numbers = (steps + 1) * dataset.observation_size;
  if (episode.observations.size() != numbers) {
    return absl::InvalidArgumentError(absl::StrCat(
        "observations: expected ", numbers, " numbers, received ", episode.observations.size()));
  }
  if (!episode.labels.empty() && episode.labels.size() != steps) {
    return absl::InvalidArgumentError(
        absl::StrCat("labels: expected ", steps, " or none, received ", episode.labels.size()));
  }
  if (!episode.weights.empty() && episode.weights.size() != steps) {
    return absl::InvalidArgumentError(
        absl::StrCat("weights: expected ", steps, " or none, received ", episode.weights.size()));
  }
  for (const auto* actions : {&episode.actions, &episode.labels}) {
    for (const Action& action : *actions) {
      RETURN_IF_ERROR(dataset.action_space.Contains(action));
    }
  }
  return episode.served.has_value() ? CheckServed(dataset, *episode.served, steps)
                                    : absl::OkStatus();
}

absl::StatusOr<Dataset> Concatenate(std::vector<Dataset> datasets) {
  SPIKESERVE_DCHECK(!datasets.empty());
  Dataset all = std::move(datasets[0]);
  if (datasets.size() == 1) return all;
  Json recipes = Json::array({std::move(all.recipe)});
  for (Dataset& dataset : absl::MakeSpan(datasets).subspan(1)) {
    if (dataset.environment != all.environment) {
      return absl::InvalidArgumentError(absl::StrCat("data: expected all of ", all.environment,
                                                     ", received one of ", dataset.environment));
    }
    if (dataset.observation_size != all.observation_size ||
        dataset.action_space != all.action_space) {
      return absl::InvalidArgumentError(
          absl::StrCat("data: expected equal spaces in all datasets of ", all.environment,
                       ", received other ones in dataset ", recipes.size() + 1));
    }
    recipes.push_back(std::move(dataset.recipe));
    std::move(dataset.episodes.begin(), dataset.episodes.end(), std::back_inserter(all.episodes));
  }
  all.recipe = Json{{"parts", std::move(recipes)}};
  return all;
}

absl::Status WriteDataset(const Dataset& dataset, const std::string& path) {
  return WriteFileAtomically(path, {SerializeDataset(dataset)});
}

absl::StatusOr<Dataset> ReadDataset(const std::string& path) {
  ASSIGN_OR_RETURN(const std::string bytes, ReadFile(path));
  absl::StatusOr<Dataset> dataset = ParseDataset(bytes);
  return dataset.ok() ? std::move(dataset) : Annotate(dataset.status(), path);
}

}  // namespace spikeserve
