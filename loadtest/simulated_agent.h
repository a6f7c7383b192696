// An agent without an environment: it sends random observations within a bound and a reward of 1
// per step, or the steps of a recorded episode, in episodes of a fixed length.
//
// Not thread-safe. A seed gives the same observations on every machine.
#pragma once

#include <chrono>
#include <cstdint>
#include <optional>
#include <random>
#include <string>
#include <utility>

#include "absl/status/status.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "loadtest/recorded_episode.h"
#include "spikeserve/remote_session.h"
#include "spikeserve/retry.h"
#include "spikeserve/status.h"

namespace spikeserve {

class SimulatedAgent {
 public:
  // The first episode has `first_episode_steps` steps and all later ones `episode_steps`, so that
  // the episodes of agents that start together can end at different times. The entries of the
  // observations are in [-observation_bound, observation_bound]. REQUIRES: `session` is at step 0.
  SimulatedAgent(RemoteSession session, int observation_size, int first_episode_steps,
                 int episode_steps, uint64_t seed, double observation_bound = 1.0)
      : session_(std::move(session)),
        steps_left_(first_episode_steps),
        episode_steps_(episode_steps),
        observation_bound_(observation_bound),
        random_(static_cast<std::minstd_rand::result_type>(seed)),
        observation_(observation_size) {
    SPIKESERVE_DCHECK_EQ(session_.step(), 0);
    MakeRequest();
  }

  // Sends the steps of `recorded`, and after them the first ones again. REQUIRES: `session` is at
  // step 0; `recorded` outlives the agent and is not empty.
  SimulatedAgent(RemoteSession session, const RecordedEpisode* recorded, int first_episode_steps,
                 int episode_steps)
      : session_(std::move(session)),
        steps_left_(first_episode_steps),
        episode_steps_(episode_steps),
        recorded_(recorded) {
    SPIKESERVE_DCHECK_EQ(session_.step(), 0);
    MakeRequest();
  }

  const std::string& session_id() const { return session_.session_id(); }

  // Returns the request of the current step; it does not change until Accept().
  const v1::ActRequest& request() const { return request_; }

  // Takes the answer and makes the next request. After the last step of an episode it first ends
  // the episode, a call that waits for the server. Returns INTERNAL if the answer belongs to
  // another request, or the error of that call.
  absl::Status Accept(const v1::ActResponse& response) {
    RETURN_IF_ERROR(session_.Accept(response));
    if (--steps_left_ == 0) {
      episode_over_ = true;
      return EndEpisode();
    }
    MakeRequest();
    return absl::OkStatus();
  }

  // Makes the agent ready to send after `error`: opens a new session if the server has lost it,
  // sends decisions again that the server misses, and ends the episode if its end has failed.
  // Returns the error of these calls.
  absl::Status Resume(const absl::Status& error) {
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

  // Returns whether Resume can replace a lost session.
  bool reopens() const { return session_.reopens(); }

  // Closes the session on the server.
  absl::Status Close() { return session_.Close(); }

  // The time at which the request was due.
  std::chrono::steady_clock::time_point due;
  std::optional<RetrySchedule> retries;  // of a request that has failed
  double longest_wait = 0.0;             // seconds from the time a request was due to its decision

 private:
  static constexpr double kReward = 1.0;

  absl::Status EndEpisode() {
    RETURN_IF_ERROR(session_.EndEpisode({.reward = kReward, .truncated = true}).status());
    StartEpisode();
    return absl::OkStatus();
  }

  void StartEpisode() {
    episode_over_ = false;
    steps_left_ = episode_steps_;
    next_ = 0;
    MakeRequest();
  }

  void MakeRequest() {
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

  RemoteSession session_;
  int steps_left_;  // remaining steps of this episode
  int episode_steps_;
  bool episode_over_ = false;                  // the end of the episode was not answered yet
  int sessions_lost_ = 0;                      // of which Resume knows
  const RecordedEpisode* recorded_ = nullptr;  // null: random observations
  size_t next_ = 0;                            // step of `recorded_`
  double observation_bound_ = 0.0;             // largest absolute value
  std::minstd_rand random_;
  std::vector<float> observation_;
  v1::ActRequest request_;
};

}  // namespace spikeserve
