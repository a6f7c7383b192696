#include "train/recording/policy_player.h"

#include <utility>

#include "absl/strings/str_cat.h"
#include "core/action/action_head.h"
#include "core/contract/dcheck.h"

namespace spikeserve {

absl::Status CheckSpacesMatch(const Policy& policy, const Environment& environment) {
  if (environment.observation_size() == policy.observation_size() &&
      environment.action_space() == policy.action_space) {
    return absl::OkStatus();
  }
  return absl::InvalidArgumentError(
      absl::StrCat("policy: expected the observations and actions of ",
                   absl::string_view(environment.id().data(), environment.id().size())));
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
