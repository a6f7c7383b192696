// Replays recorded episodes with the same or another version of a policy, and compares every
// decision bit for bit.
#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/dataset/dataset.h"
#include "nlohmann/json.hpp"
#include "spikeserve/client.h"

namespace spikeserve {

// The first decision that differs from the recording.
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
  int64_t episodes = 0;                            // replayed completely
  int64_t decisions = 0;                           // number of equal decisions
  std::map<std::string, int64_t> steps_by_source;  // who chose the executed actions of these
  std::optional<ReplayDifference> difference;
};

// Returns INVALID_ARGUMENT unless `recording` can be replayed. It must hold the served episodes of
// one session without learning, one dataset per episode, in order. If actions were sampled, it must
// start with the first episode of the session and have no gap, because the random draws of an
// episode depend on the episodes before it.
absl::Status CheckReplayable(const std::vector<Dataset>& recording);

// Replays `recording` in a new session until a decision differs. If `policy` is empty, uses the
// policy of the recording, and its version if `version` is 0. Otherwise a `version` of 0 is the
// default version of `policy`. REQUIRES: CheckReplayable returns OK.
absl::StatusOr<ReplayResult> Replay(const std::vector<Dataset>& recording,
                                    const std::string& policy, int64_t version, Client& client);

}  // namespace spikeserve
