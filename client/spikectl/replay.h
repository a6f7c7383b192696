// Plays recorded episodes again, through the same or another version of a policy, and compares
// every decision bit for bit.
#ifndef CLIENT_SPIKECTL_REPLAY_H_
#define CLIENT_SPIKECTL_REPLAY_H_

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/dataset/dataset.h"
#include "nlohmann/json.hpp"
#include "spikeserve/client.h"

namespace spikeserve {

// The first decision that came out otherwise.
struct ReplayDifference {
  int64_t episode = 0;  // of the recorded session
  int64_t step = 0;
  std::string field;  // action, action_probabilities, return_to_go or spikes
  nlohmann::json recorded;
  nlohmann::json replayed;
};

struct ReplayResult {
  std::string policy;
  int64_t version = 0;
  int64_t episodes = 0;   // played to their end
  int64_t decisions = 0;  // equal ones
  std::optional<ReplayDifference> difference;
};

// INVALID_ARGUMENT unless `recording` can be played again: served episodes of one session without
// learning, one dataset each, in their order; where actions were drawn, from the session's first
// episode on and without a gap, since the draws go on from one to the next.
absl::Status CheckReplayable(const std::vector<Dataset>& recording);

// Plays `recording` in a session of its own until a decision differs. An empty `policy` and a
// `version` of 0 are those of the recording; with a `policy`, 0 is its default version. REQUIRES:
// CheckReplayable said yes.
absl::StatusOr<ReplayResult> Replay(const std::vector<Dataset>& recording,
                                    const std::string& policy, int64_t version, Client& client);

}  // namespace spikeserve

#endif  // CLIENT_SPIKECTL_REPLAY_H_
