#include "loadtest/simulated_agent.h"

#include <utility>

#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "spikeserve/status.h"

namespace spikeserve {
namespace {

constexpr double kReward = 1.0;

}  // namespace

SimulatedAgent::SimulatedAgent(RemoteSession session, int observation_size, int first_episode_steps,
                               int episode_steps, uint64_t seed, double observation_bound)
    : session_(std::move(session)),
      steps_left_(first_episode_steps),
      episode_steps_(episode_steps),
      observation_bound_(observation_bound),
      random_(static_cast<std::minstd_rand::result_type>(seed)),
      observation_(observation_size) {
  SPIKESERVE_DCHECK_EQ(session_.step(), 0);
  MakeRequest();
}

SimulatedAgent::SimulatedAgent(RemoteSession session, const RecordedEpisode* recorded,
                               int first_episode_steps, int episode_steps)
    : session_(std::move(session)),
      steps_left_(first_episode_steps),
      episode_steps_(episode_steps),
      recorded_(recorded) {
  SPIKESERVE_DCHECK_EQ(session_.step(), 0);
  MakeRequest();
}

absl::Status SimulatedAgent::Accept(const v1::ActResponse& response) {
  RETURN_IF_ERROR(session_.Accept(response));
  if (--steps_left_ == 0) {
    episode_over_ = true;
    return EndEpisode();
  }
  MakeRequest();
  return absl::OkStatus();
}

absl::Status SimulatedAgent::EndEpisode() {
  RETURN_IF_ERROR(session_.EndEpisode({.reward = kReward, .truncated = true}).status());
  StartEpisode();
  return absl::OkStatus();
}

void SimulatedAgent::StartEpisode() {
  episode_over_ = false;
  steps_left_ = episode_steps_;
  next_ = 0;
  MakeRequest();
}

absl::Status SimulatedAgent::Resume(const absl::Status& error) {
  if (ExpectedDecision(error).has_value()) {
    RETURN_IF_ERROR(session_.CatchUp(error));
  }
  if (!IsSessionLost(error)) return episode_over_ ? EndEpisode() : absl::OkStatus();
  // The end of an episode has opened a new session by itself.
  if (session_.reopened() == sessions_lost_) {
    RETURN_IF_ERROR(session_.OpenAgain());
  }
  sessions_lost_ = session_.reopened();
  StartEpisode();
  return absl::OkStatus();
}

void SimulatedAgent::MakeRequest() {
  if (recorded_ != nullptr) {
    const RecordedStep& step = (*recorded_)[next_++ % recorded_->size()];
    request_ = session_.MakeRequest(step.observation, step.reward);
    return;
  }
  // Computed by hand, because the standard distributions differ between libraries.
  constexpr double kHalf = (std::minstd_rand::max() - std::minstd_rand::min()) / 2.0;
  for (float& value : observation_) {
    const double unit = (random_() - std::minstd_rand::min()) / kHalf - 1.0;
    value = static_cast<float>(observation_bound_ * unit);
  }
  request_ = session_.MakeRequest(observation_, kReward);
}

}  // namespace spikeserve
