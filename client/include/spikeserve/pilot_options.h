// The settings of a pilot (pilot.h).
#ifndef SPIKESERVE_PILOT_OPTIONS_H_
#define SPIKESERVE_PILOT_OPTIONS_H_

#include <cstddef>
#include <functional>
#include <memory>
#include <optional>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "absl/types/span.h"
#include "spikeserve/local_policy.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// Writes a line of a pilot to the standard error.
void LogPilotToStderr(absl::string_view line);

// How the steps of a pilot go to the server. The ends of episodes, and steps that are too long for
// a datagram, always go over the stream.
enum class PilotTransport {
  kAuto,      // as datagrams where the server takes them and they come through
  kStream,    // over the stream
  kDatagram,  // as kAuto; a server that takes no datagrams is refused
};

// How a pilot finds the action of a beat. The fallback order, from the best to the last one:
//
//   source | action                                             | setting
//   fresh  | an answer of the server, at most `max_age` old     | max_age
//   held   | the last fresh action again, for a few beats       | hold_beats; 0: never
//   local  | the engine on the robot, in the same session       | local; null: none
//   safe   | the way to the neutral action, then that action    | neutral, ramp_beats
//   safe   | after it, what the robot's own function returns    | fallback
struct PilotOptions {
  absl::Duration period;  // between two beats, 1 ms to an hour
  // How long a beat may wait for an answer, at most `period`. Absent: half a period. With 0, a beat
  // waits neither for the server nor for the engine on the robot.
  std::optional<absl::Duration> budget = std::nullopt;
  // The age of its observation from which on an answer is stale, and never executed. Absent: 0.25
  // s, or three periods if that is more.
  std::optional<absl::Duration> max_age = std::nullopt;
  int hold_beats = 3;
  std::shared_ptr<LocalPolicy> local = nullptr;
  std::optional<v1::Action> neutral = std::nullopt;  // absent: the neutral action of the policy
  // Beats from the last action to the neutral one. Absent: those of 0.2 s. 0: no ramp.
  std::optional<int> ramp_beats = std::nullopt;
  // Returns the action for an observation [obs], whose elements are all NaN if the observation of
  // the beat is not valid. Runs on the thread of Beat and counts for its time. The action is read
  // before the next call. An action that does not belong to the action space, or an exception, is
  // replaced by the neutral action.
  std::function<ActionView(absl::Span<const float> observation)> fallback = nullptr;
  // Returns the W3C Trace Context of a beat (traceparent), or nothing. Runs on the thread of Beat.
  // The text is read before the next call.
  std::function<absl::string_view()> traceparent = nullptr;
  // Most requests without an answer, 1 to 64. Absent: so many that later answers would be stale.
  std::optional<int> in_flight = std::nullopt;
  PilotTransport transport = PilotTransport::kAuto;
  // How often each datagram is sent, 1 or 2. With 2, a step is lost only if both are.
  int redundancy = 1;
  // Beats that are kept with their observations until the server has them; of older ones, the
  // rewards are kept. At least 2. They take 4 bytes for each element of an observation.
  int kept_beats = 8192;
  // How long Close waits for the ends of episodes that the server does not have.
  absl::Duration close_timeout = absl::Seconds(5);
  // Receives a line when a source is entered or something fails, on the background thread, for
  // which the other pilots of the client wait. Must not throw. Null: the lines are lost.
  std::function<void(absl::string_view)> log = LogPilotToStderr;

  // Returns INVALID_ARGUMENT that names the field, the expected and the received value.
  absl::Status Validate() const;

  // The settings in effect.
  absl::Duration wait() const { return budget.value_or(period / 2); }
  absl::Duration oldest() const;
  absl::Duration oldest_held() const { return oldest() + hold_beats * period; }
  int ramp() const;
  size_t most_in_flight() const;
};

}  // namespace spikeserve

#endif  // SPIKESERVE_PILOT_OPTIONS_H_
