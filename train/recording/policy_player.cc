#include "train/recording/policy_player.h"

#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "absl/strings/string_view.h"
#include "core/action/action_head.h"
#include "core/base/status.h"
#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

std::string SpaceText(const ActionSpace& space) {
  constexpr size_t kMostShown = 8;
  if (space.is_discrete()) return absl::StrCat("Discrete(", space.n, ")");
  if (space.low.size() > kMostShown) return absl::StrCat("Box of ", space.low.size());
  return absl::StrCat("Box from [", absl::StrJoin(space.low, ", "), "] to [",
                      absl::StrJoin(space.high, ", "), "]");
}

// Compares the spaces of a dataset with those that `owner` has.
absl::Status CheckSpaces(const Dataset& dataset, int observation_size, const ActionSpace& actions,
                         absl::string_view owner) {
  if (dataset.observation_size != observation_size) {
    return InvalidArgument(
        "--data",
        absl::StrCat("observations of ", observation_size, " numbers, as ", owner, " has"),
        dataset.observation_size);
  }
  if (dataset.action_space == actions) return absl::OkStatus();
  return InvalidArgument(
      "--data", absl::StrCat("the action space ", SpaceText(actions), ", as ", owner, " has"),
      SpaceText(dataset.action_space));
}

}  // namespace

absl::Status CheckSpacesMatch(const Policy& policy, const Environment& environment) {
  if (environment.observation_size() == policy.observation_size() &&
      environment.action_space() == policy.action_space) {
    return absl::OkStatus();
  }
  return absl::InvalidArgumentError(
      absl::StrCat("policy: expected the observations and actions of ",
                   absl::string_view(environment.id().data(), environment.id().size())));
}

absl::Status CheckSpacesMatch(const Policy& policy, const Dataset& dataset) {
  return CheckSpaces(dataset, policy.observation_size(), policy.action_space, "the policy");
}

absl::Status CheckSpacesMatch(const Environment& environment, const Dataset& dataset) {
  return CheckSpaces(dataset, environment.observation_size(), environment.action_space(),
                     dataset.environment);
}

PolicyPlayer::PolicyPlayer(const Engine& engine, double target_return)
    : engine_(engine), context_(engine.NewContext()), return_to_go_(target_return) {}

Action PolicyPlayer::Act(absl::Span<const float> observation, double reward) {
  const Policy& policy = engine_.policy();
  if (encoded_.empty()) {
    encoded_.resize(policy.action_space.size());
  } else {
    return_to_go_ -= reward;
    engine_.AppendAction(*context_, encoded_);
  }
  engine_.Decide(*context_, static_cast<float>(return_to_go_), observation, &output_);
  ActionChoice choice =
      ChooseAction(policy.weights.head, policy.action_space, output_.readout, {}, 0);
  policy.action_space.Encode(choice.action, absl::MakeSpan(encoded_));
  return std::move(choice.action);
}

void PolicyPlayer::Executed(const Action& action) {
  SPIKESERVE_DCHECK(!encoded_.empty());
  engine_.policy().action_space.Encode(action, absl::MakeSpan(encoded_));
}

}  // namespace spikeserve
