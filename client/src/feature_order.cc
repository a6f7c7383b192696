#include "spikeserve/feature_order.h"

#include <algorithm>

namespace spikeserve {
namespace {

using Names = google::protobuf::RepeatedPtrField<std::string>;
using FeatureList = google::protobuf::RepeatedPtrField<v1::Feature>;

std::vector<size_t> Taken(const Names& robot, const FeatureList& policy) {
  std::vector<size_t> taken;
  if (robot.size() != policy.size()) return taken;
  for (const v1::Feature& feature : policy) {
    const auto found = std::find(robot.begin(), robot.end(), feature.name());
    if (found == robot.end()) return {};
    taken.push_back(static_cast<size_t>(found - robot.begin()));
  }
  return std::is_sorted(taken.begin(), taken.end()) ? std::vector<size_t>() : taken;
}

void Replace(absl::Span<const float> values, google::protobuf::RepeatedField<float>* field) {
  if (values.data() == field->data()) return;
  std::copy(values.begin(), values.end(), field->begin());
}

}  // namespace

FeatureOrder::FeatureOrder(const v1::OpenSessionRequest& request,
                           const v1::OpenSessionResponse& opened) {
  observation_.taken = Taken(request.observation_names(), opened.observation_features());
  observation_.buffer.resize(observation_.taken.size());
  action_.taken = Taken(request.action_names(), opened.action_features());
  action_.buffer.resize(action_.taken.size());
}

absl::Span<const float> FeatureOrder::Places::ToPolicy(absl::Span<const float> robot) {
  if (taken.empty() || robot.size() != taken.size()) return robot;
  for (size_t i = 0; i < taken.size(); ++i) buffer[i] = robot[taken[i]];
  return buffer;
}

absl::Span<const float> FeatureOrder::Places::ToRobot(absl::Span<const float> policy) {
  if (taken.empty() || policy.size() != taken.size()) return policy;
  for (size_t i = 0; i < taken.size(); ++i) buffer[taken[i]] = policy[i];
  return buffer;
}

absl::Span<const float> FeatureOrder::Observation(absl::Span<const float> robot) {
  return observation_.ToPolicy(robot);
}

absl::Span<const float> FeatureOrder::Action(absl::Span<const float> robot) {
  return action_.ToPolicy(robot);
}

int64_t FeatureOrder::Action(int64_t robot) const {
  const auto found =
      std::find(action_.taken.begin(), action_.taken.end(), static_cast<size_t>(robot));
  return found == action_.taken.end() ? robot : found - action_.taken.begin();
}

absl::Span<const float> FeatureOrder::RobotObservation(absl::Span<const float> policy) {
  return observation_.ToRobot(policy);
}

absl::Span<const float> FeatureOrder::RobotAction(absl::Span<const float> policy) {
  return action_.ToRobot(policy);
}

int64_t FeatureOrder::RobotAction(int64_t policy) const {
  const bool is_known = policy >= 0 && static_cast<size_t>(policy) < action_.taken.size();
  return is_known ? static_cast<int64_t>(action_.taken[static_cast<size_t>(policy)]) : policy;
}

void FeatureOrder::ToPolicy(v1::Action* action) {
  if (action->has_discrete()) return action->set_discrete(Action(action->discrete()));
  auto* const values = action->mutable_continuous()->mutable_values();
  Replace(Action(*values), values);
}

void FeatureOrder::ToRobot(v1::ActResponse* response) {
  if (action_.taken.empty()) return;
  v1::Action* const action = response->mutable_action();
  if (action->has_discrete()) {
    action->set_discrete(RobotAction(action->discrete()));
    Replace(RobotAction(response->action_probabilities()),
            response->mutable_action_probabilities());
  } else {
    auto* const values = action->mutable_continuous()->mutable_values();
    Replace(RobotAction(*values), values);
  }
}

}  // namespace spikeserve
