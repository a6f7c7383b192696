#include "train/data/minari_metadata.h"

#include <cmath>
#include <limits>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/strings/strip.h"
#include "core/base/json.h"
#include "core/base/json_object.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "train/data/minari_layout.h"

namespace spikeserve {
namespace {

constexpr int64_t kLargestJointSpace = 4096;  // the outputs of an action head
constexpr int64_t kLargestBox = 1 << 20;      // numbers
constexpr int64_t kLargestStart = 1 << 30;    // of the indices

// Parses Python's dialect of JSON. What standard JSON lacks is replaced outside of texts:
// infinities become +-1e300, which is beyond the range of float, and NaN becomes null.
absl::StatusOr<nlohmann::json> ParsePython(absl::string_view field, absl::string_view text) {
  std::string standard;
  bool in_text = false;
  while (!text.empty()) {
    if (!in_text && absl::ConsumePrefix(&text, "Infinity")) {
      standard += "1e300";
    } else if (!in_text && absl::ConsumePrefix(&text, "NaN")) {
      standard += "null";
    } else {
      const size_t length = in_text && text[0] == '\\' && text.size() > 1 ? 2 : 1;
      if (text[0] == '"') in_text = !in_text;
      absl::StrAppend(&standard, text.substr(0, length));
      text.remove_prefix(length);
    }
  }
  return ParseJsonObject(field, standard);
}

float ToFloat(double x) {
  const bool finite = std::abs(x) <= static_cast<double>(std::numeric_limits<float>::max());
  return finite ? static_cast<float>(x) : std::copysign(std::numeric_limits<float>::infinity(), x);
}

// Appends `json`, a number or a nested list of numbers, to `bounds`.
absl::Status AppendBounds(absl::string_view field, const nlohmann::json& json,
                          std::vector<float>* bounds) {
  if (json.is_array()) {
    for (const nlohmann::json& item : json) {
      RETURN_IF_ERROR(AppendBounds(field, item, bounds));
    }
    return absl::OkStatus();
  }
  double bound = 0.0;
  auto status = ReadJson(field, json, &bound);
  bounds->push_back(ToFloat(bound));
  return status;
}

// Appends `json`, an integer or a nested list of integers, to `values`.
absl::Status AppendIntegers(absl::string_view field, const nlohmann::json& json,
                            std::vector<int64_t>* values) {
  if (json.is_array()) {
    for (const nlohmann::json& item : json) {
      RETURN_IF_ERROR(AppendIntegers(field, item, values));
    }
    return absl::OkStatus();
  }
  int64_t value = 0;
  auto status = ReadJson(field, json, &value);
  values->push_back(value);
  return status;
}

// A space as described by Minari's serialisation of Gymnasium spaces.
struct SpaceDescription {
  std::string type;
  int size = 1;        // Box: numbers
  nlohmann::json low;  // Box: a number, or a nested list of numbers
  nlohmann::json high;
  IndexLayout indices;  // Discrete and MultiDiscrete

  // Returns one bound per entry of a Box; repeats a single number for all entries.
  absl::StatusOr<std::vector<float>> Bounds(absl::string_view field,
                                            const nlohmann::json& json) const {
    std::vector<float> bounds;
    RETURN_IF_ERROR(AppendBounds(field, json, &bounds));
    if (bounds.size() == 1) bounds.resize(size, bounds[0]);
    return bounds;
  }
};

// Returns the number of numbers in a Box.
absl::StatusOr<int> SizeOf(absl::string_view field, const std::vector<int>& shape) {
  int64_t size = 1;
  for (const int dimension : shape) {
    if (dimension < 1 || dimension > kLargestBox / size) {
      return InvalidArgument(
          field, absl::StrCat("dimensions of at least 1 and at most ", kLargestBox, " numbers"),
          absl::StrCat("a dimension of ", dimension));
    }
    size *= dimension;
  }
  return static_cast<int>(size);
}

absl::StatusOr<IndexLayout> ReadIndexLayout(absl::string_view field, const nlohmann::json& counts,
                                            const nlohmann::json& starts) {
  IndexLayout layout;
  RETURN_IF_ERROR(AppendIntegers(field, counts, &layout.counts));
  if (!starts.is_null()) {
    RETURN_IF_ERROR(AppendIntegers(field, starts, &layout.starts));
  }
  for (const int64_t start : layout.starts) {
    if (start < -kLargestStart || start > kLargestStart) {
      return InvalidArgument(absl::StrCat(field, ".start"),
                             absl::StrCat(-kLargestStart, " to ", kLargestStart), start);
    }
  }
  layout.starts.resize(layout.counts.size());
  return layout;
}

absl::StatusOr<SpaceDescription> ParseSpace(absl::string_view field, absl::string_view text) {
  ASSIGN_OR_RETURN(const auto parsed, ParsePython(field, text));
  SpaceDescription space;
  nlohmann::json counts, starts;
  std::vector<int> shape;
  JsonObject object(field, parsed);
  object.AllowOtherKeys();
  object.Required("type", &space.type);
  if (space.type == "Box") {
    object.Required("shape", &shape);
    object.Required("low", &space.low);
    object.Required("high", &space.high);
  } else if (space.type == "Discrete") {
    object.Required("n", &counts);
    object.Optional("start", &starts);
  } else if (space.type == "MultiDiscrete") {
    object.Required("nvec", &counts);
    object.Optional("start", &starts);
  }
  RETURN_IF_ERROR(object.Finish());
  ASSIGN_OR_RETURN(space.size, SizeOf(field, shape));
  if (counts.is_null()) return space;
  ASSIGN_OR_RETURN(space.indices, ReadIndexLayout(field, counts, starts));
  return space;
}

// Returns the Discrete space of all combinations of the elements.
absl::StatusOr<ActionSpace> JointSpace(const IndexLayout& indices) {
  int64_t joint = 1;
  for (const int64_t count : indices.counts) {
    if (count < 1 || count > kLargestJointSpace) {
      return InvalidArgument("action_space", absl::StrCat("1 to ", kLargestJointSpace, " indices"),
                             count);
    }
    joint *= count;
    if (joint > kLargestJointSpace) {
      return InvalidArgument("action_space",
                             absl::StrCat("at most ", kLargestJointSpace, " combinations"), "more");
    }
  }
  return ActionSpace::Discrete(static_cast<int>(joint));
}

absl::StatusOr<ActionSpace> ToActionSpace(const SpaceDescription& description) {
  ActionSpace space;
  if (!description.indices.counts.empty()) {
    auto joint = JointSpace(description.indices);
    if (!joint.ok()) return joint;
    space = *std::move(joint);
  } else if (description.type == "Box") {
    ASSIGN_OR_RETURN(auto low, description.Bounds("action_space.low", description.low));
    ASSIGN_OR_RETURN(auto high, description.Bounds("action_space.high", description.high));
    space = ActionSpace::Box(std::move(low), std::move(high));
  } else {
    return InvalidArgument("action_space", "Discrete, MultiDiscrete or Box", description.type);
  }
  if (auto status = space.Validate(); !status.ok()) return Annotate(status, "action_space");
  return space;
}

}  // namespace

absl::StatusOr<MinariMetadata> ParseMinariMetadata(absl::string_view text) {
  ASSIGN_OR_RETURN(const auto metadata, ParsePython("metadata", text));
  MinariMetadata description;
  std::string id, observation_space, action_space, format = "hdf5";
  nlohmann::json own, environment;
  JsonObject object("metadata", metadata);
  object.AllowOtherKeys();
  object.Required("dataset_id", &id);
  object.Required("observation_space", &observation_space);
  object.Required("action_space", &action_space);
  object.Required("total_episodes", &description.episodes, 0);
  object.Optional("data_format", &format);
  object.Optional("env_spec", &environment);
  object.Optional(kMinariExtension, &own);
  RETURN_IF_ERROR(object.Finish());
  if (format != "hdf5") {
    return InvalidArgument("data_format",
                           "hdf5, which `python -m spikeserve convert --to=minari` writes",
                           Quoted(format));
  }
  ASSIGN_OR_RETURN(const auto observations, ParseSpace("observation_space", observation_space));
  if (observations.type != "Box") {
    return InvalidArgument("observation_space", "Box",
                           absl::StrCat(observations.type,
                                        "; record with Gymnasium's FlattenObservation, or flatten "
                                        "it by `python -m spikeserve convert --to=minari`"));
  }
  ASSIGN_OR_RETURN(const auto actions, ParseSpace("action_space", action_space));
  ASSIGN_OR_RETURN(auto space, ToActionSpace(actions));
  Dataset& dataset = description.dataset;
  dataset = {.environment = id,
             .observation_size = observations.size,
             .action_space = std::move(space),
             .recipe = {{"minari", id}},
             .episodes = {}};
  description.indices = actions.indices;
  if (!own.is_null()) {
    JsonObject ours(kMinariExtension, own);
    ours.Required("environment", &dataset.environment);
    ours.Required("recipe", &dataset.recipe);
    RETURN_IF_ERROR(ours.Finish());
  } else if (environment.is_string()) {
    ASSIGN_OR_RETURN(const auto spec,
                     ParsePython("env_spec", environment.get_ref<const std::string&>()));
    JsonObject of_gymnasium("env_spec", spec);
    of_gymnasium.AllowOtherKeys();
    of_gymnasium.Required("id", &dataset.environment);
    RETURN_IF_ERROR(of_gymnasium.Finish());
  }
  return description;
}

}  // namespace spikeserve
