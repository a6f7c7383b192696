// Defines what an episode contributes to the shared head of a fleet, and what becomes of it. Plain
// values.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "Eigen/Core"
#include "core/learning/head_update.h"
#include "core/learning/learning_options.h"
#include "core/learning/return_statistics.h"

namespace spikeserve {

// The learning of a session in one episode.
struct LearningSummary {
  Scope scope = Scope::kSession;
  int64_t updates = 0;          // applied to the head; scope fleet: to the contribution
  int64_t rejected = 0;         // updates that were refused: not finite, or by the fleet's head
  double head_drift = 0.0;      // of the head that the session uses
  ReturnStatistics returns;     // mu and sigma^2, with this episode included
  bool rolled_back = false;     // the guard restored the last good head
  double watched_return = 0.0;  // level of the guard's last window; see return_guard.h
};

struct Contribution {
  static constexpr size_t kMostOperators = 8;

  // Identify it: the session and the index of its episode.
  std::string session = "";
  int64_t episode = 0;
  std::string head = "";  // tenant whose head it is for (TenantHeads)
  // The session, or its tenant if several share the head; empty: no client, no budget applies.
  std::string contributor = "";
  bool held_out = false;  // of the session, see held_out.h
  // Who acted in the policy's place, so that no guard judges the return; the first kMostOperators.
  std::vector<std::string> operators = {};
  // [act * d]: sum of the updates, in the precision in which it is stored, sent and applied.
  Eigen::VectorXf delta = {};
  double episode_return = 0.0;
  LearningSummary summary = {};  // of the episode, without the outcome of the merge
};

// The outcome of a contribution at its place among the others.
struct MergeOutcome {
  bool paused = false;  // learning was paused: the head has not taken it
  UpdateOutcome update = UpdateOutcome::kApplied;
  bool rolled_back = false;     // a guard restored an earlier head
  double drift = 0.0;           // of the head after it
  double watched_return = 0.0;  // level of the guard's last window after it
  // Of an undo: contributions that were taken out; -1: the head no longer has them one by one.
  int64_t undone = 0;
};

// Completes the summary of an episode with the outcome of its contribution.
inline void TakeOutcome(const MergeOutcome& outcome, LearningSummary* summary) {
  if (IsRefusedByFleet(outcome.update)) summary->rejected += std::exchange(summary->updates, 0);
  summary->rolled_back = outcome.rolled_back;
  summary->head_drift = outcome.drift;
  summary->watched_return = outcome.watched_return;
}

}  // namespace spikeserve
