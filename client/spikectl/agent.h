// A remote agent: the environment is stepped here, the decisions come from the server.
#ifndef CLIENT_SPIKECTL_AGENT_H_
#define CLIENT_SPIKECTL_AGENT_H_

#include <cstdint>

#include "absl/status/statusor.h"
#include "client/tools/latency_histogram.h"
#include "core/environment/environment.h"
#include "spikeserve/remote_session.h"

namespace spikeserve {

// One episode, or the sum of many.
struct EpisodeRecord {
  double episode_return = 0.0;
  int64_t steps = 0;
  uint64_t spikes = 0;
  // Estimates: what the server reports as `energy_joules`, and the energy model horowitz_45nm.
  double energy_joules = 0.0;
  double horowitz_energy_joules = 0.0;
  LatencyHistogram latency;  // seconds from the call of Act to its return, retries included

  EpisodeRecord& operator+=(const EpisodeRecord& other);
};

// Plays one episode from the environment's start state for `seed` and ends it on the server. Errors
// of the session's calls; INTERNAL if an action is not one of the environment's.
absl::StatusOr<EpisodeRecord> PlayEpisode(Environment& environment, RemoteSession& session,
                                          uint64_t seed);

// Makes the first `steps` decisions of an episode, fewer where it ends before, and leaves it
// unended. Errors as above.
absl::Status PlaySteps(Environment& environment, RemoteSession& session, uint64_t seed, int steps);

}  // namespace spikeserve

#endif  // CLIENT_SPIKECTL_AGENT_H_
