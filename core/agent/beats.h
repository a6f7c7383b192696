// Appends to a session what its robot did without the server: the beats of a running episode that
// no request asked for, or whose requests were lost.
//
//   BeatHistory history = {.step = 7, .decision = 7, .beats = {beat5, beat6}};
//   auto appended = AppendBeats(history, &agent);  // steps 5 and 6; then agent.Act(7, ...)
//
// A beat is appended as the decision that the policy would have made there, in whose place the
// executed action then is. The session is therefore equal, bit for bit, to one that was asked for
// every step and told the executed actions. The robot gets no answer, and nothing counts as a
// decision of the server.
//
// Not thread-safe, like the session.
#ifndef CORE_AGENT_BEATS_H_
#define CORE_AGENT_BEATS_H_

#include <cstdint>
#include <limits>
#include <optional>

#include "absl/functional/function_ref.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/types/span.h"
#include "core/action/reported_action.h"
#include "core/agent/agent_session.h"

namespace spikeserve {

// One beat. Views of a request.
struct Beat {
  int64_t step = 0;                     // within the episode
  absl::Span<const float> observation;  // empty: the robot had no valid one
  double reward = 0.0;                  // of the action before
  ReportedAction executed;
  bool has_reward = true;  // false: it was left out, and `reward` is 0
};

// The beats directly before a request's step, without a gap.
struct BeatHistory {
  int64_t step = 0;                  // of the request
  std::optional<uint64_t> decision;  // of the request, in the session
  // Rewards of the steps before `beats`, whose observations are not known.
  absl::Span<const double> skipped_rewards;
  size_t size = 0;                       // of `beats`
  absl::FunctionRef<Beat(size_t)> beat;  // in their order; the last one has step - 1
  absl::Span<const float> observation;   // of the request; empty: it asks for no decision
  double reward = 0.0;                   // of the request
  std::optional<double> end_reward = std::nullopt;  // the last one of an episode that ends
  bool is_checked = false;                          // an earlier call has appended beats of it
};

// What AppendBeats has done.
struct AppendedBeats {
  int64_t appended = 0;         // with their observations
  int64_t dropped = 0;          // as rewards only, with or without an observation
  int64_t missing_rewards = 0;  // of these, after step 0
  bool finished = true;         // false: more beats are to be appended by another call
};

// The most beats of one request that are appended with their observations; of longer ones the older
// beats are dropped. A robot that has more sends them in several requests.
inline constexpr int64_t kHistoryLimit = 1024;

// The most skipped rewards of one request.
inline constexpr int64_t kMostSkippedRewards = 65536;

// Appends the beats that the session does not have, at most `most` of them (at least 1), and calls
// `on_appended` after each. Returns, without having changed the session: INVALID_ARGUMENT, which
// names the field, if the history or what follows it is not valid; FAILED_PRECONDITION if it does
// not reach back to the step that the session expects, belongs to another episode, or has another
// content of steps that the session has (repeated_step.h). The first beat for a stored
// session is not the one that it expects: its server may have lost what was executed before it.
// Returns INTERNAL if the policy's answer to a beat is not finite; the beats before it are
// appended then. A history that is older than the session adds nothing.
//
// A beat without an observation counts as a skipped reward: the context begins again behind it.
// Such beats at the end of the history are taken only if `history` has an observation or ends the
// episode, because a session is never left without a context. REQUIRES: the decision or the end
// follows then.
absl::StatusOr<AppendedBeats> AppendBeats(
    const BeatHistory& history, AgentSession* agent,
    int64_t most = std::numeric_limits<int64_t>::max(),
    absl::FunctionRef<void(const Beat&)> on_appended = [](const Beat&) {});

// Puts the executed action of the newest beat in the place of the answer, for a request that asks
// for no decision. Does nothing if the session has decided since. REQUIRES: AppendBeats has
// finished.
absl::Status TakeLastExecuted(const BeatHistory& history, AgentSession* agent);

}  // namespace spikeserve

#endif  // CORE_AGENT_BEATS_H_
