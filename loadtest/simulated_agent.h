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

#include "absl/status/status.h"
#include "loadtest/recorded_episode.h"
#include "spikeserve/remote_session.h"
#include "spikeserve/retry.h"

namespace spikeserve {

class SimulatedAgent {
 public:
  // The first episode has `first_episode_steps` steps and all later ones `episode_steps`, so that
  // the episodes of agents that start together can end at different times. The entries of the
  // observations are in [-observation_bound, observation_bound]. REQUIRES: `session` is at step 0.
  SimulatedAgent(RemoteSession session, int observation_size, int first_episode_steps,
                 int episode_steps, uint64_t seed, double observation_bound = 1.0);
  // Sends the steps of `recorded`, and after them the first ones again. REQUIRES: `session` is at
  // step 0; `recorded` outlives the agent and is not empty.
  SimulatedAgent(RemoteSession session, const RecordedEpisode* recorded, int first_episode_steps,
                 int episode_steps);

  const std::string& session_id() const { return session_.session_id(); }

  // Returns the request of the current step; it does not change until Accept().
  const v1::ActRequest& request() const { return request_; }

  // Takes the answer and makes the next request. After the last step of an episode it first ends
  // the episode, a call that waits for the server. Returns INTERNAL if the answer belongs to
  // another request, or the error of that call.
  absl::Status Accept(const v1::ActResponse& response);

  // Makes the agent ready to send after `error`: opens a new session if the server has lost it,
  // sends decisions again that the server misses, and ends the episode if its end has failed.
  // Returns the error of these calls.
  absl::Status Resume(const absl::Status& error);
  // Returns whether Resume can replace a lost session.
  bool reopens() const { return session_.reopens(); }

  // Closes the session on the server.
  absl::Status Close() { return session_.Close(); }

  // The time at which the request was due.
  std::chrono::steady_clock::time_point due;
  std::optional<RetrySchedule> retries;  // of a request that has failed
  double longest_wait = 0.0;             // seconds from the time a request was due to its decision

 private:
  absl::Status EndEpisode();
  void StartEpisode();
  void MakeRequest();

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
