// An agent without an environment: random observations within a bound, reward 1 a step, episodes of
// a fixed length.
//
// Not thread-safe. The same seed makes the same observations on every machine.
#ifndef LOADTEST_SIMULATED_AGENT_H_
#define LOADTEST_SIMULATED_AGENT_H_

#include <chrono>
#include <cstdint>
#include <random>
#include <string>

#include "absl/status/status.h"
#include "spikeserve/remote_session.h"

namespace spikeserve {

class SimulatedAgent {
 public:
  // `session` is at step 0. The first episode has `first_episode_steps`, so that agents which start
  // together need not end together; later ones have `episode_steps`.
  SimulatedAgent(RemoteSession session, int observation_size, int first_episode_steps,
                 int episode_steps, uint64_t seed, double observation_bound = 1.0);

  const std::string& session_id() const { return session_.session_id(); }

  // The request of this step; the same one until it was answered.
  const v1::ActRequest& request() const { return request_; }

  // Takes the answer and makes the next request; ends the episode first where it is due, which
  // waits for the server. INTERNAL if the answer is not to this request, or the error of the call.
  absl::Status Accept(const v1::ActResponse& response);

  absl::Status Close() { return session_.Close(); }

  // When the request was to be handed over.
  std::chrono::steady_clock::time_point due;

 private:
  void MakeRequest();

  RemoteSession session_;
  int steps_left_;  // in this episode
  int episode_steps_;
  double observation_bound_;  // of their absolute values
  std::minstd_rand random_;
  std::vector<float> observation_;
  v1::ActRequest request_;
};

}  // namespace spikeserve

#endif  // LOADTEST_SIMULATED_AGENT_H_
