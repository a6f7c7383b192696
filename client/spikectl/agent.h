// A remote agent: steps an environment in this process with the decisions of the server.
#pragma once

#include <array>
#include <cstdint>
#include <optional>

#include "absl/status/statusor.h"
#include "client/spikectl/distance.h"
#include "client/tools/latency_histogram.h"
#include "core/engine/energy.h"
#include "core/environment/environment.h"
#include "spikeserve/remote_session.h"

namespace spikeserve {

// The measurements of one episode, or the sums over many.
struct EpisodeRecord {
  double episode_return = 0.0;
  int64_t steps = 0;
  uint64_t spikes = 0;
  // Estimates of the server, indexed by EnergyModel. Absent for a model that does not apply to the
  // policy.
  std::array<std::optional<double>, kEnergyModels> joules;
  LatencyHistogram latency;  // seconds from the call of Act to its return, retries included

  EpisodeRecord& operator+=(const EpisodeRecord& other);
};

// How episodes are played.
struct PlayOptions {
  double rate = 0.0;  // most decisions a second; 0: as many as it can
  // Decisions are executed late or never, and the server is told what was executed.
  Distance distance = {};
};

// Plays one episode from the environment's start state for `seed` and ends it on the server.
// Returns the errors of the session's calls, and INTERNAL if an action is invalid for the
// environment.
absl::StatusOr<EpisodeRecord> PlayEpisode(Environment& environment, RemoteSession& session,
                                          uint64_t seed, const PlayOptions& options = {});

// Makes the first `steps` decisions of an episode, or fewer if it ends earlier, and does not end
// the episode on the server. Errors as above.
absl::Status PlaySteps(Environment& environment, RemoteSession& session, uint64_t seed, int steps);

}  // namespace spikeserve
