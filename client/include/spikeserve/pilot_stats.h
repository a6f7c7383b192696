// What a pilot (pilot.h) has done. Plain values.
#ifndef SPIKESERVE_PILOT_STATS_H_
#define SPIKESERVE_PILOT_STATS_H_

#include <array>
#include <cstddef>
#include <cstdint>
#include <string>

#include "absl/strings/string_view.h"
#include "absl/time/time.h"

namespace spikeserve {

// Who chose an action: the fallback order in PilotOptions.
enum class ActionSource { kFresh, kHeld, kLocal, kSafe };
inline constexpr size_t kActionSources = 4;

// Returns "fresh", "held", "local" or "safe".
absl::string_view ActionSourceName(ActionSource source);

// Counts since the pilot began.
struct PilotStats {
  using BySource = std::array<uint64_t, kActionSources>;

  uint64_t beats = 0;
  BySource by_source = {};        // beats, by ActionSource
  BySource entries = {};          // how often each source was entered, by ActionSource
  uint64_t stale = 0;             // answers that came too late, and were not executed
  uint64_t late_answers = 0;      // answers that took longer than a period; they may be fresh still
  uint64_t cancelled_calls = 0;   // requests that failed, or were given up with their stream
  uint64_t datagram_answers = 0;  // answers that came as datagrams
  bool sends_datagrams = false;   // steps go as datagrams now, and no longer over the stream
  uint64_t reconnects = 0;        // streams that were opened in the place of another one
  uint64_t reopened = 0;          // sessions that were opened in the place of a lost one
  uint64_t dropped = 0;           // beats that the server got as rewards only
  uint64_t lost_episodes = 0;     // episodes whose end the server never learned
  uint64_t unequal_returns = 0;   // episodes whose return at the server was not that at the robot
  uint64_t invalid = 0;           // observations, rewards or executed actions that were not valid
  uint64_t invalid_observations = 0;  // beats without a valid observation
  // What was expected and received in the place of the last of these; empty: all were valid.
  std::string last_invalid_observation;
  uint64_t failures = 0;       // calls of the fall-back that failed
  absl::Duration longest_gap;  // without a fresh action
  // Ages of the actions but the safe ones, exact to 2 %.
  absl::Duration age_p50;
  absl::Duration age_p99;
  absl::Duration age_p999;
  bool has_local = false;  // the engine on the robot is ready
  // The engine on the robot plays with a shared head as of the last episode, which the fleet may
  // have changed meanwhile.
  bool local_head_is_copy = false;
  // The server keeps the robot at its safe action: the session is held, or looks miswired.
  bool stays_safe = false;

  uint64_t of(ActionSource source) const { return by_source[static_cast<size_t>(source)]; }
};

}  // namespace spikeserve

#endif  // SPIKESERVE_PILOT_STATS_H_
