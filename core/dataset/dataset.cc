#include "core/dataset/dataset.h"

#include <algorithm>
#include <cmath>
#include <initializer_list>
#include <iterator>
#include <set>
#include <string>
#include <tuple>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "absl/types/span.h"
#include "core/base/file.h"
#include "core/base/json.h"
#include "core/base/printable.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "core/dataset/amendments.h"
#include "core/dataset/dataset_cbor.h"

namespace spikeserve {

namespace {

using Json = nlohmann::json;

absl::Status CheckServed(const Dataset& dataset, const ServedEpisode& served, size_t steps) {
  const size_t n = dataset.action_space.is_discrete() ? dataset.action_space.n : 0;
  // Servers of former releases recorded no noise.
  const size_t noise = served.noise.empty() ? 0 : steps * dataset.action_space.low.size();
  const std::tuple<const char*, size_t, size_t> lengths[] = {
      {"returns_to_go", served.returns_to_go.size(), steps},
      {"probabilities", served.probabilities.size(), steps * n},
      {"spikes", served.spikes.size(), steps},
      {"logits", served.logits.size(), noise},
      {"noise", served.noise.size(), noise}};
  for (const auto& [field, length, expected] : lengths) {
    if (length == expected) continue;
    return InvalidArgument(absl::StrCat("served.", field), expected, length);
  }
  if (!served.answered_actions.empty() && served.answered_actions.size() != steps) {
    return InvalidArgument("served.answered_actions", absl::StrCat(steps, " or none"),
                           served.answered_actions.size());
  }
  if (!served.sources.empty() && served.sources.size() != steps) {
    return InvalidArgument("served.sources", absl::StrCat(steps, " sources"),
                           served.sources.size());
  }
  if (!served.received_rewards.empty() && served.received_rewards.size() != steps) {
    return InvalidArgument("served.received_rewards", absl::StrCat(steps, " or none"),
                           served.received_rewards.size());
  }
  for (const Action& action : served.answered_actions) {
    RETURN_IF_ERROR(dataset.action_space.Contains(action));
  }
  return absl::OkStatus();
}

absl::Status CheckNumber(double number, absl::string_view where) {
  if (std::abs(number) <= kLargestDataNumber) return absl::OkStatus();
  return InvalidArgument(
      where, absl::StrCat("a finite number", std::isfinite(number) ? " of at most 1e18" : ""),
      number);
}

// Checks [rows, columns]; names the row as a step. One column is not named.
template <typename T>
absl::Status CheckNumbers(absl::string_view name, absl::Span<const T> numbers, size_t columns) {
  for (size_t i = 0; i < numbers.size(); ++i) {
    if (std::abs(numbers[i]) <= static_cast<T>(kLargestDataNumber)) continue;  // false for NaN
    const std::string element = columns > 1 ? absl::StrCat(", element ", i % columns) : "";
    return CheckNumber(numbers[i], absl::StrCat(name, ": step ", i / columns, element));
  }
  return absl::OkStatus();
}

absl::Status CheckObservations(const Dataset& dataset, const Episode& episode) {
  const auto size = static_cast<size_t>(dataset.observation_size);
  absl::Span<const float> observations = episode.observations;
  const absl::Span<const float> last = observations.last(size);
  const bool unknown = std::all_of(last.begin(), last.end(), [](float x) { return std::isnan(x); });
  if (unknown) observations.remove_suffix(size);
  return CheckNumbers("observations", observations, size);
}

absl::Status CheckWeights(const Episode& episode) {
  RETURN_IF_ERROR(CheckNumbers<float>("weights", episode.weights, 1));
  const auto negative = std::find_if(episode.weights.begin(), episode.weights.end(),
                                     [](float weight) { return weight < 0.0f; });
  if (negative == episode.weights.end()) return absl::OkStatus();
  return InvalidArgument(absl::StrCat("weights: step ", negative - episode.weights.begin()),
                         "a number of at least 0", *negative);
}

absl::Status CheckActions(absl::string_view name, const ActionSpace& space,
                          const std::vector<Action>& actions) {
  for (size_t step = 0; step < actions.size(); ++step) {
    const absl::Status status = space.Contains(actions[step]);
    if (!status.ok()) return Annotate(status, absl::StrCat(name, ": step ", step));
  }
  return absl::OkStatus();
}

// Returns INVALID_ARGUMENT if two recipes have other names for the elements of their arrays. Files
// without names fit all.
absl::Status CheckNames(const char* key, const Json& first, const Json& other) {
  const auto name = [key](const Json& recipe) {
    return recipe.is_object() && recipe.contains(key) ? recipe[key] : Json();
  };
  const Json expected = name(first), received = name(other);
  if (expected.is_null() || received.is_null() || expected == received) return absl::OkStatus();
  return InvalidArgument(absl::StrCat("data: ", key),
                         absl::StrCat(expected.dump(), " in all datasets"), received.dump());
}

// Returns INVALID_ARGUMENT unless `key` of the recipe is absent, or lists one name of `counts`
// each that a terminal shows. An index has one name, or one for each of its values.
absl::Status CheckNamesFit(const Dataset& dataset, const char* key,
                           std::initializer_list<int> counts) {
  if (!dataset.recipe.is_object() || !dataset.recipe.contains(key)) return absl::OkStatus();
  const Json& names = dataset.recipe[key];
  std::set<std::string> known;
  for (const Json& name : names) {
    const bool printable = name.is_string() && IsPrintable(name.get_ref<const std::string&>());
    if (printable) known.insert(name.get<std::string>());
  }
  const bool counted =
      std::find(counts.begin(), counts.end(), static_cast<int>(names.size())) != counts.end();
  const bool fits = names.is_array() && known.size() == names.size() && counted;
  if (fits || names.empty()) return absl::OkStatus();
  return InvalidArgument(
      absl::StrCat("recipe.", key),
      absl::StrCat(absl::StrJoin(counts, " or "), " different names of printable characters"),
      names.dump());
}

absl::Status CheckDescription(const Dataset& dataset) {
  if (!IsPrintable(dataset.environment)) {
    return InvalidArgument("environment", "printable characters", Quoted(dataset.environment));
  }
  RETURN_IF_ERROR(CheckNamesFit(dataset, "observation_names", {dataset.observation_size}));
  const ActionSpace& space = dataset.action_space;
  return space.is_discrete() ? CheckNamesFit(dataset, "action_names", {1, space.n})
                             : CheckNamesFit(dataset, "action_names", {space.size()});
}

void RoundToBounds(const ActionSpace& space, std::vector<Action>* actions) {
  constexpr double kRounding = 1e-6;  // of the range
  for (Action& action : *actions) {
    if (action.continuous.size() != space.low.size()) return;  // CheckEpisode names it
    for (size_t i = 0; i < space.low.size(); ++i) {
      const double low = space.low[i], high = space.high[i];
      const double slack = kRounding * (high - low), value = action.continuous[i];
      if (value < low - slack || value > high + slack || std::isnan(value)) continue;
      action.continuous[i] = static_cast<float>(std::clamp(value, low, high));
    }
  }
}

}  // namespace

absl::Status CheckEpisode(const Dataset& dataset, const Episode& episode) {
  RETURN_IF_ERROR(CheckDescription(dataset));
  const size_t steps = episode.actions.size();
  if (steps == 0) return InvalidArgument("actions", "at least one", "none");
  if (episode.rewards.size() != steps) {
    return InvalidArgument("rewards", steps, episode.rewards.size());
  }
  const size_t numbers = (steps + 1) * dataset.observation_size;
  if (episode.observations.size() != numbers) {
    return InvalidArgument("observations", absl::StrCat(numbers, " numbers"),
                           episode.observations.size());
  }
  if (!episode.labels.empty() && episode.labels.size() != steps) {
    return InvalidArgument("labels", absl::StrCat(steps, " or none"), episode.labels.size());
  }
  if (!episode.weights.empty() && episode.weights.size() != steps) {
    return InvalidArgument("weights", absl::StrCat(steps, " or none"), episode.weights.size());
  }
  RETURN_IF_ERROR(CheckObservations(dataset, episode));
  RETURN_IF_ERROR(CheckNumbers<double>("rewards", episode.rewards, 1));
  RETURN_IF_ERROR(CheckWeights(episode));
  RETURN_IF_ERROR(CheckNumber(episode.target_return.value_or(0.0), "asked_return"));
  RETURN_IF_ERROR(CheckActions("actions", dataset.action_space, episode.actions));
  RETURN_IF_ERROR(CheckActions("labels", dataset.action_space, episode.labels));
  return episode.served.has_value() ? CheckServed(dataset, *episode.served, steps)
                                    : absl::OkStatus();
}

absl::Status AcceptEpisode(const Dataset& dataset, Episode* episode) {
  if (!dataset.action_space.is_discrete()) {
    RoundToBounds(dataset.action_space, &episode->actions);
    RoundToBounds(dataset.action_space, &episode->labels);
  }
  return CheckEpisode(dataset, *episode);
}

absl::StatusOr<Dataset> Concatenate(std::vector<Dataset> datasets) {
  SPIKESERVE_DCHECK(!datasets.empty());
  Dataset all = std::move(datasets[0]);
  if (datasets.size() == 1) return all;
  Json names = Json::object();  // of the first dataset that has some
  const auto note_names = [&names](const Json& recipe) -> absl::Status {
    for (const char* key : {"observation_names", "action_names"}) {
      RETURN_IF_ERROR(CheckNames(key, names, recipe));
      if (recipe.is_object() && recipe.contains(key)) names[key] = recipe[key];
    }
    return absl::OkStatus();
  };
  RETURN_IF_ERROR(note_names(all.recipe));
  Json recipes = Json::array({std::move(all.recipe)});
  for (Dataset& dataset : absl::MakeSpan(datasets).subspan(1)) {
    if (dataset.environment != all.environment) {
      return InvalidArgument("data", absl::StrCat("all of ", all.environment),
                             absl::StrCat("one of ", dataset.environment));
    }
    if (dataset.observation_size != all.observation_size ||
        dataset.action_space != all.action_space) {
      return InvalidArgument("data",
                             absl::StrCat("equal spaces in all datasets of ", all.environment),
                             absl::StrCat("other ones in dataset ", recipes.size() + 1));
    }
    RETURN_IF_ERROR(note_names(dataset.recipe));
    recipes.push_back(std::move(dataset.recipe));
    std::move(dataset.episodes.begin(), dataset.episodes.end(), std::back_inserter(all.episodes));
  }
  all.recipe = std::move(names);
  all.recipe["parts"] = std::move(recipes);
  return all;
}

absl::Status WriteDataset(const Dataset& dataset, const std::string& path) {
  return WriteFileAtomically(path, {SerializeDataset(dataset)});
}

absl::StatusOr<Dataset> ReadDataset(const std::string& path) {
  ASSIGN_OR_RETURN(const std::string bytes, ReadFile(path));
  absl::StatusOr<Dataset> dataset = ParseDataset(bytes);
  if (!dataset.ok()) return Annotate(dataset.status(), path);
  RETURN_IF_ERROR(ReadAmendments(path, &*dataset).status());
  return dataset;
}

}  // namespace spikeserve
