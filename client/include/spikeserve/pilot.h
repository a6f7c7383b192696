// Flies one robot: every beat has an action in time, whatever the link does. The action is fresh
// from the server if possible; PilotOptions lists what takes its place.
//
//   v1::OpenSessionRequest request;
//   request.set_policy("pendulum");
//   auto pilot = Pilot::Create(client.get(), request, {.period = absl::Milliseconds(20)});
//   while (flying) {
//     const PilotAction action = (*pilot)->Beat(observation, reward);
//     ...  // executes action.value, and waits for the next beat
//   }
//
// The server's session is what happened on the robot. A background thread brings it all beats, in
// order and once, whoever chose their actions (docs/reference/beats.md). Answers that come too late
// are not executed, and neither are those from before a reconnection.
//
// For one thread; Stats may be called from any.
#ifndef SPIKESERVE_PILOT_H_
#define SPIKESERVE_PILOT_H_

#include <cstdint>
#include <future>
#include <memory>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "absl/types/span.h"
#include "spikeserve/client.h"
#include "spikeserve/feature_order.h"
#include "spikeserve/local_policy.h"
#include "spikeserve/pilot_options.h"
#include "spikeserve/pilot_stats.h"
#include "spikeserve/remote_session.h"

namespace spikeserve {

// The action of one beat.
struct PilotAction {
  ActionView value;  // valid until the next call of the pilot
  ActionSource source = ActionSource::kSafe;
  // From the observation that the action was chosen for to the return of Beat, with the time in
  // which the computer was suspended. Of a safe action: from the last observation that an action
  // was chosen for.
  absl::Duration age;
  uint64_t beat = 0;  // counts the beats of the pilot from 0
  // INVALID_ARGUMENT as long as no observation was valid: the robot is not wired right. It names
  // the field, the expected and the received value; the action is the neutral one, and the call
  // counts as no beat.
  absl::Status status = absl::OkStatus();
};

class Pilot {
 public:
  // Opens a session with the server and waits for it, as Client::OpenSession does, and takes its
  // value to the engine on the robot, if there is one. `client` must outlive the pilot. Returns
  // INVALID_ARGUMENT if `options` are not valid or the neutral action does not belong to the action
  // space; UNIMPLEMENTED if the server is older than histories; and the errors of OpenSession and
  // of LocalPolicy::Resume.
  static absl::StatusOr<std::unique_ptr<Pilot>> Create(Client* client,
                                                       v1::OpenSessionRequest request,
                                                       PilotOptions options);
  // Closes the pilot.
  ~Pilot();

  // Returns the action for an observation [obs], in environment units, at most `budget` later.
  // Never throws, and allocates no memory after the first beats.
  //
  // `reward` is for the action of the beat before; the first beat of an episode ignores it.
  // `executed` is what the robot executed in the beat before, if it differs from the returned
  // action, for example because a safety layer clipped it. A reward or an executed action that is
  // not valid is replaced by 0, or by what was returned.
  //
  // A beat whose observation has another size, or a number that is not finite, has a held or a safe
  // action. Before the first valid observation there is none: see PilotAction::status.
  PilotAction Beat(absl::Span<const float> observation, double reward = 0.0,
                   const std::optional<ActionView>& executed = std::nullopt) noexcept;

  using Summary = absl::StatusOr<v1::EndEpisodeResponse>;

  // Ends the episode; the next beat begins another one. Does not wait. The future has the server's
  // summary once the server has all beats of the episode, or UNAVAILABLE if the session was lost or
  // the pilot closed before. An episode without a beat has an empty summary.
  std::future<Summary> EndEpisode(const EpisodeOutcome& outcome);

  // Waits for an answer that the next beat may execute, for at most `timeout`. Returns whether
  // there is one. The first beats of an episode have none on a slow link; a robot that stands still
  // calls this after its first beat. An answer that is older than max_age then is not executed all
  // the same.
  bool WaitReady(absl::Duration timeout);

  // Returns what the pilot has done so far. Thread-safe.
  PilotStats Stats() const;

  // Returns the id of the session at the server, which changes if the server has lost it.
  // Thread-safe.
  std::string session_id() const;

  // Waits until the server has the ends of all episodes, for `close_timeout` at most, then closes
  // the session. Later beats have safe actions.
  void Close();

 private:
  class Controller;

  Pilot(std::unique_ptr<Controller> controller, FeatureOrder order);

  FeatureOrder order_;  // of the robot's elements, if the request names them
  const std::unique_ptr<Controller> controller_;
};

}  // namespace spikeserve

#endif  // SPIKESERVE_PILOT_H_
