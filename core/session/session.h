// A session as a plain value: everything that one remote agent's past means for its future.
//
// It can be written out, moved to another process and restored, and goes on bit for bit as it would
// have. Keys and values are not here: they are a cache (Engine::Context) that the history rebuilds.
#ifndef CORE_SESSION_SESSION_H_
#define CORE_SESSION_SESSION_H_

#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/action/action_head.h"
#include "core/action/action_space.h"
#include "core/engine/counts.h"
#include "core/learning/learner.h"
#include "core/learning/learning_options.h"
#include "core/session/episode.h"
#include "core/session/history.h"

namespace spikeserve {

// The answer to one Act, kept so that a retry gets it byte for byte.
struct Answer {
  int64_t step = 0;
  Action action;
  std::vector<float> probabilities;  // Discrete spaces only
  float return_to_go = 0.0f;         // what the decision was conditioned on
  Counts counts;
  double compute_seconds = 0.0;
  std::vector<float> logits;  // of the head as it was when it decided

  friend bool operator==(const Answer&, const Answer&) = default;
};

// What is fixed when a session opens.
struct SessionOptions {
  std::string policy;
  int64_t version = 0;         // resolved, >= 1
  double target_return = 0.0;  // G_0 of each episode that names no other
  uint64_t seed = 0;
  ActionSelection action_selection;
  std::map<std::string, std::string> labels;
  std::string tenant;  // whose session it is; empty where the server has no tenants
  std::optional<LearningOptions> learning;  // absent: the head stays as it is
  std::vector<float> head_delta;  // [act, d]: what the head starts as beyond W_base; empty: W_base
};

struct Session {
  std::string id;
  SessionOptions options;

  // The running episode.
  int64_t episode = 0;         // counts from 0
  int64_t step = 0;            // decisions answered in this episode, so also the step expected next
  double target_return = 0.0;  // G_0 of this episode
  double return_to_go = 0.0;   // of the last answered decision; target_return before the first
  double episode_return = 0.0;  // rewards received so far
  uint64_t episode_spikes = 0;
  double episode_energy_joules = 0.0;
  History history;  // the last timesteps, at most HistorySize() of them
  std::optional<Answer> last_answer;
  // Of the episode before, until this one's first decision; null otherwise.
  std::shared_ptr<const EndedEpisode> last_end;

  // Over the session's life.
  uint64_t decisions =
      0;  // also the counter of its random draws, keyed by (options.seed, decisions)
  uint64_t spikes = 0;
  double energy_joules = 0.0;
  std::optional<Learner> learner;  // present where options.learning is
};

// A compact binary form (CBOR) and back, equal bit for bit. INVALID_ARGUMENT if `bytes` is not such
// a form.
std::string SerializeSession(const Session& session);
absl::StatusOr<Session> ParseSession(const std::string& bytes);

}  // namespace spikeserve

#endif  // CORE_SESSION_SESSION_H_
