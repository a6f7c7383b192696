// The state of a roll-out, which moves the new sessions of a policy from its stable version to a
// new one, step by step. The settings file keeps it.
//
// Plain values and free functions without shared state; safe to call from many threads.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <iterator>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "core/base/enum_names.h"
#include "nlohmann/json.hpp"
#include "server/metrics/version_evidence.h"

namespace spikeserve {

// Versions are positive.
inline constexpr int64_t kFirstVersion = 1;

enum class RolloutMeasure { kReturn, kErrors, kP99 };

constexpr std::array<EnumName<RolloutMeasure>, 3> EnumNames(RolloutMeasure) {
  return {{{RolloutMeasure::kReturn, "return"},
           {RolloutMeasure::kErrors, "errors"},
           {RolloutMeasure::kP99, "p99"}}};
}

enum class RolloutState { kRunning, kCompleted, kAborted, kCancelled };

constexpr std::array<EnumName<RolloutState>, 4> EnumNames(RolloutState) {
  return {{{RolloutState::kRunning, "running"},
           {RolloutState::kCompleted, "completed"},
           {RolloutState::kAborted, "aborted"},
           {RolloutState::kCancelled, "cancelled"}}};
}

// By how much the new version may be worse in one measure; see RolloutCondition in
// policy_admin.proto.
struct RolloutCondition {
  RolloutMeasure measure = RolloutMeasure::kReturn;
  double margin = 0.0;

  friend bool operator==(const RolloutCondition&, const RolloutCondition&) = default;
};

struct Rollout {
  int64_t version = 0;
  int64_t stable_version = 0;
  std::vector<int> steps = {};  // percent of the new sessions; ascending
  double hold_seconds = 600.0;
  int64_t min_episodes = 20;  // of the new version, before a step is left
  std::vector<RolloutCondition> abort_if = {};

  RolloutState state = RolloutState::kRunning;
  int64_t step = 0;              // index in `steps`
  double held_seconds = 0.0;     // of this step, while a server was running
  int64_t episodes_at_step = 0;  // `capped_episodes` of the new version, when the step began
  double started = 0.0;          // Unix times in seconds
  double step_started = 0.0;
  double ended = 0.0;       // 0 while it is running
  std::string reason = "";  // why it ended
  // Why it waits, because one tenant's sessions decide whether the version is worse; empty: it does
  // not wait for that.
  std::string disputed = "";
  // The server whose sessions judge it, if several share their settings; empty: any.
  std::string replica = "";
  EvidenceByTenant new_evidence = {};
  EvidenceByTenant stable_evidence = {};
  // The OfflineEvaluation with which it was started, as JSON (proto/json.h); empty: none.
  std::string offline_evaluation = "";

  bool running() const { return state == RolloutState::kRunning; }
  int percent() const { return steps[static_cast<size_t>(step)]; }
  // Whether the end of this step gives all new sessions to the new version.
  bool enters_all() const {
    return steps[static_cast<size_t>(std::min(step + 1, std::ssize(steps) - 1))] == 100;
  }
  // How many episodes of one session count towards `min_episodes` in each step: a fifth.
  int64_t most_episodes_per_session() const { return (min_episodes + 4) / 5; }

  // Returns INVALID_ARGUMENT, which names the field, unless every value is in its range.
  absl::Status Validate() const;

  friend bool operator==(const Rollout&, const Rollout&) = default;
};

nlohmann::json RolloutJson(const Rollout& rollout);
absl::Status ReadJson(absl::string_view field, const nlohmann::json& json, Rollout* rollout);

}  // namespace spikeserve
