// Lets a policy decide again at every step of recorded episodes, and compares the probabilities of
// the recorded actions.
//
// Pure functions; safe to call from many threads.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/action/step_source.h"
#include "core/dataset/dataset.h"
#include "core/model/policy.h"
#include "train/evaluation/off_policy.h"

namespace spikeserve {

// How the new policy would play; absent: as recorded.
struct OffPolicyConditions {
  std::optional<double> temperature = std::nullopt;
  std::optional<double> target_return = std::nullopt;
};

struct RecordedDecisions {
  std::string policy;  // that played the episodes
  int64_t version = 0;
  std::string sha256;  // of its file; empty: unknown
  // Steps by who chose their actions. Only the policy's own answers have a probability. What others
  // have chosen belongs to the task, which both versions would have met: it has the ratio 1. So
  // does a filter of the robot that changes an answer, which keeps the answer's ratio.
  std::array<size_t, kSourceKinds> steps = {};
  // Each session is a unit; if there are fewer than kFewestUnits, each episode. Sessions with equal
  // seeds draw equal random numbers, so they are one unit.
  std::vector<OffPolicyEpisode> episodes;
};

// `recordings` are those of ReadRecordings(): one dataset for each episode, in the order of the
// sessions. Returns INVALID_ARGUMENT, which says what to record instead, if the episodes do not fit
// the policy, are of several versions or too few, or if a session learned or chose its actions
// greedily.
absl::StatusOr<RecordedDecisions> DecideRecorded(const std::vector<Dataset>& recordings,
                                                 std::shared_ptr<const Policy> policy,
                                                 const OffPolicyConditions& conditions);

}  // namespace spikeserve
