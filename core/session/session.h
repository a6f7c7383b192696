// Defines a session as a plain value: all of an agent's past that influences its future.
//
// It can be serialized, moved to another process and restored, and then continues bit for bit as it
// would have. Keys and values are not part of it: they are a cache (Engine::Context) that is
// rebuilt from the history.
#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "Eigen/Core"
#include "core/action/action_head.h"
#include "core/action/action_space.h"
#include "core/action/step_source.h"
#include "core/engine/counts.h"
#include "core/learning/contribution.h"
#include "core/learning/learner.h"
#include "core/learning/learning_options.h"
#include "core/session/durability.h"
#include "core/session/episode.h"
#include "core/session/history.h"
#include "core/session/wiring_state.h"

namespace spikeserve {

// While a session is held, it answers with the neutral action and learns nothing.
struct Hold {
  std::string id;
  std::string reason;  // for people

  friend bool operator==(const Hold&, const Hold&) = default;
};

// The operator who acts in the place of the policy.
struct Seat {
  std::string operator_id;
  std::string lease_id;
  double lease_seconds = 0.0;
  // Of the lease, when the session decided last. A server that takes the session over goes on from
  // here, so no clocks are compared.
  double left_seconds = 0.0;
  Action action;             // that the session answers with
  int64_t steps = 0;         // that were answered so
  int64_t agreed_steps = 0;  // those for which the policy had chosen the same action

  friend bool operator==(const Seat&, const Seat&) = default;
};

// The answer to one Act, stored so that a retry gets the same bytes.
struct Answer {
  int64_t step = 0;
  Action action;
  std::vector<float> probabilities;  // Discrete spaces only
  float return_to_go = 0.0f;         // what the decision was conditioned on
  Counts counts;
  uint32_t unusual_observations = 0;  // elements of the observation far from the training data
  double compute_seconds = 0.0;
  std::vector<float> logits;  // of the head at the time of the decision
  StepSource source;          // who chose `action`
  std::optional<Hold> hold;   // source kHold only

  friend bool operator==(const Answer&, const Answer&) = default;
};

// The properties of a session that are fixed when it is opened.
struct SessionOptions {
  std::string policy;
  int64_t version = 0;         // resolved, >= 1
  double target_return = 0.0;  // G_0 of every episode that sets no other
  uint64_t seed = 0;
  ActionSelection action_selection;
  std::map<std::string, std::string> labels;
  std::string tenant;  // owner of the session; empty if the server has no tenants
  std::optional<LearningOptions> learning;  // absent: the head is frozen
  // [act * d], row-major: initial value of W - W_base; empty: zero.
  Eigen::VectorXf head_delta;
  Durability durability = Durability::kNone;
  std::string recording;      // name of the session's recording; empty: not recorded
  std::string policy_sha256;  // of the policy's file, in hexadecimal; empty: unknown
};

// The value of a session.
struct Session {
  std::string id;
  SessionOptions options;

  // The running episode.
  int64_t episode = 0;  // index of the episode, from 0
  int64_t step = 0;     // decisions answered in this episode, which is the next step expected
  double target_return = 0.0;   // G_0 of this episode
  double return_to_go = 0.0;    // of the last answered decision; target_return before the first
  double episode_return = 0.0;  // sum of the rewards received so far
  uint64_t episode_spikes = 0;
  double episode_energy_joules = 0.0;
  History history;  // last timesteps, at most HistorySize()
  std::optional<Answer> last_answer;
  StepSource executed_source;  // who chose the last action of `history`, as far as it is known
  // End of the previous episode. A session that was restored has it only until the first decision
  // of this one.
  std::shared_ptr<const EndedEpisode> last_end;

  // Over the session's life.
  uint64_t decisions = 0;  // all decisions; with options.seed, the key of its random draws
  uint64_t spikes = 0;
  double energy_joules = 0.0;
  std::optional<Learner> learner;  // present if and only if options.learning is
  // What the last episode of a fleet session contributes to the shared head, until it is in the log
  // of the head (head_log.h); null: nothing.
  std::shared_ptr<const Contribution> pending;
  WiringState wiring;
  std::optional<Seat> seat;       // absent: no operator acts in the policy's place
  std::vector<Verdict> verdicts;  // the last kMostVerdicts, oldest first
  uint64_t interventions = 0;     // verdicts, hand-overs of control and undone corrections

  static constexpr size_t kMostVerdicts = 64;

  // Returns how often the session has changed: of two copies, the one with less has lost something.
  uint64_t changes() const { return decisions + static_cast<uint64_t>(episode) + interventions; }
};

}  // namespace spikeserve
