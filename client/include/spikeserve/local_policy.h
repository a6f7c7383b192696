// The place of an engine on the robot, which decides while the server is out of reach.
//
// The client library defines it and links no engine. LocalEngine (local_engine.h), in a library of
// its own, implements it with the engine of this project:
//
//   PilotOptions options = {.period = absl::Milliseconds(20), .local = LocalEngine::FromServer()};
#ifndef SPIKESERVE_LOCAL_POLICY_H_
#define SPIKESERVE_LOCAL_POLICY_H_

#include <cstdint>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/types/span.h"
#include "spikeserve/remote_session.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// Who chose an action; UNKNOWN: what chose the action that the pilot returned, if it is that one. A
// name that is longer than 128 bytes, not in UTF-8 or not an OPERATOR's is left out.
struct ChosenBy {
  v1::ActionSource::Kind kind = v1::ActionSource::UNKNOWN;
  absl::string_view operator_id = {};
};

// An action of a policy's action space that somebody else owns: an index of a Discrete space, or
// one number for each element of a Box, in environment units.
struct ActionView {
  int64_t discrete = 0;
  absl::Span<const float> continuous = {};
  ChosenBy by = {};
};

// Plays the same session as the server: every beat that the robot plays, in order and once. A pilot
// calls it on its background thread only. Errors make the pilot resume from the server's value.
class LocalPolicy {
 public:
  virtual ~LocalPolicy() = default;

  // Returns whether `Resume` needs ExportSessionResponse.policy_file.
  virtual bool NeedsPolicyFile() const = 0;

  // Goes on with the session that the server has exported, in the place of the one before. Returns
  // INVALID_ARGUMENT or FAILED_PRECONDITION if the policy is not the one that the server plays.
  virtual absl::Status Resume(const v1::ExportSessionResponse& exported) = 0;

  // Decides for an observation [obs]. `reward` is for the action before, and `executed` is what the
  // robot executed there; absent at step 0. Returns INTERNAL if the session expects another step.
  // The action is valid until the next call. An empty observation stands for one that was not
  // valid: decides nothing, and counts the step as the server does.
  virtual absl::StatusOr<ActionView> Act(int64_t step, absl::Span<const float> observation,
                                         double reward,
                                         const std::optional<ActionView>& executed) = 0;

  // Ends the episode, whose last executed action is `executed` (not that of `outcome`).
  virtual absl::Status EndEpisode(const EpisodeOutcome& outcome, const ActionView& executed) = 0;
};

}  // namespace spikeserve

#endif  // SPIKESERVE_LOCAL_POLICY_H_
