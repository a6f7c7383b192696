#include "core/agent/shadow_session.h"

#include <cmath>
#include <optional>
#include <utility>

#include "core/base/status_macros.h"
#include "core/session/session_value.h"

namespace spikeserve {
namespace {

std::shared_ptr<const ServedPolicy> Unobserved(const ServedPolicy& candidate) {
  auto copy = std::make_shared<ServedPolicy>(candidate);
  copy->observer = std::make_shared<SessionObserver>();
  return copy;
}

SessionOptions ShadowOptions(const ServedPolicy& candidate, SessionOptions options) {
  options.version = candidate.version;
  options.learning = std::nullopt;  // the rewards are those of the serving version's actions
  return options;
}

}  // namespace

ShadowSession::ShadowSession(const ServedPolicy& candidate, const SessionOptions& options,
                             const Clock* clock)
    : candidate_(Unobserved(candidate)),
      agent_(candidate_, NewSession("", ShadowOptions(candidate, options)), clock) {}

absl::StatusOr<const Answer*> ShadowSession::Act(const ShadowStep& step) {
  if (step.step == 0 && agent_.session().step > 0) {
    RETURN_IF_ERROR(
        agent_.EndEpisode({.reward = 0.0, .target_return = step.target_return}).status());
  }
  if (step.step == 0) episode_ = step.episode;
  if (step.episode != episode_) {
    return absl::FailedPreconditionError(
        "step: expected an episode that was shadowed from step 0, received a later step");
  }
  if (step.executed.has_value() && !agent_.session().history.empty()) {
    agent_.OverrideLastAction(*step.executed);
  }
  const auto answer = agent_.Act(step.step, step.observation, step.reward);
  if (answer.ok()) agent_.OverrideLastAction(step.served.action);
  return answer;
}

void ShadowSteps::OnDecision(const Session& session, const DecisionInputs& inputs) {
  const auto observation = session.history.observation(session.history.size() - 1);
  if (session.last_answer->step == 0 || inputs.after_gap) executed_.reset();
  steps_.push_back({.episode = session.episode,
                    .step = session.last_answer->step,
                    .observation = {observation.begin(), observation.end()},
                    .reward = inputs.reward,
                    .target_return = session.target_return,
                    .executed = std::exchange(executed_, std::nullopt),
                    .served = *session.last_answer});
}

bool Agree(const Action& a, const Action& b, const ActionSpace& space) {
  if (space.is_discrete()) return a.discrete == b.discrete;
  for (size_t i = 0; i < space.low.size(); ++i) {
    const float tolerance = 0.01f * (space.high[i] - space.low[i]);
    if (std::abs(a.continuous[i] - b.continuous[i]) > tolerance) return false;
  }
  return true;
}

}  // namespace spikeserve
