// One session of an agent on the server. Counts the steps, so that the server recognises repeated
// requests.
//
//   RemoteSession session(client.get(), opened->session_id(), /*step=*/0);
//   auto answer = session.Act(observation, reward);
//   session.EndEpisode({.reward = last_reward, .terminated = true});
//
// The only state is the session id and the step. A restarted agent continues its session with
// RemoteSession(&client, id, step): repeating the last answered step returns the same answer, byte
// for byte, and the episode continues from there.
//
// Not thread-safe. Several sessions may share one client from many threads.
#ifndef SPIKESERVE_REMOTE_SESSION_H_
#define SPIKESERVE_REMOTE_SESSION_H_

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/types/span.h"
#include "spikeserve/client.h"

namespace spikeserve {

// The end of an episode, in the terms of Gymnasium.
struct EpisodeOutcome {
  double reward = 0.0;  // for the last action
  bool terminated = false;
  bool truncated = false;
  std::optional<double> target_return =
      std::nullopt;                     // of the next episode; unset: as the session was opened
  std::vector<float> observation = {};  // after the last action; used by recordings only
  // The executed last action, if it differs from the answered one.
  std::optional<v1::Action> executed_action = std::nullopt;
};

class RemoteSession {
 public:
  // Opens a session. If `reopens`, a session that the server has lost (IsSessionLost) is replaced
  // by a new one with the same request: Act then decides at step 0 of its first episode, and what
  // the lost session remembered and learned is gone. EndEpisode still returns the error, because
  // the totals of the episode are lost. `client` must outlive the session.
  static absl::StatusOr<RemoteSession> Open(Client* client, v1::OpenSessionRequest request,
                                            bool reopens = false);

  // `step` is the step of the next request: a new one, or the last answered one to repeat it.
  // `client` must outlive the session.
  RemoteSession(Client* client, std::string session_id, int64_t step)
      : client_(client), session_id_(std::move(session_id)), step_(step) {}

  const std::string& session_id() const { return session_id_; }
  int64_t step() const { return step_; }

  // Returns the decision at this step and advances the step. `observation` is in raw environment
  // units; `reward` is for the previous action and ignored at step 0. `executed_action` is the
  // action that was executed at the previous step, if it differs from the answered one, for example
  // because a safety layer clipped it. Retries as Client::Act. After an error the step stays, so
  // the same call may be repeated. Returns INTERNAL if the answer is for another session or step.
  absl::StatusOr<v1::ActResponse> Act(
      absl::Span<const float> observation, double reward,
      const std::optional<v1::Action>& executed_action = std::nullopt);

  // Act in two parts, for ActBatch and streams. MakeRequest returns the request of this step;
  // Accept takes its answer and advances the step, with the errors of Act.
  v1::ActRequest MakeRequest(absl::Span<const float> observation, double reward,
                             const std::optional<v1::Action>& executed_action = std::nullopt) const;
  absl::Status Accept(const v1::ActResponse& response);

  // Ends the episode and sets the step to 0. On an error the step stays. Errors: see Client.
  absl::StatusOr<v1::EndEpisodeResponse> EndEpisode(const EpisodeOutcome& outcome);

  // The response to the request that opened the session; empty if it was not opened by Open.
  const v1::OpenSessionResponse& opening() const { return opening_; }
  // Returns whether a lost session is replaced by a new one.
  bool reopens() const { return reopening_.has_value(); }
  // Returns how often a lost session was replaced by a new one.
  int reopened() const { return reopened_; }

  // Replaces a lost session by a new one. Returns FAILED_PRECONDITION if the session does not
  // reopen, and the errors of Client::OpenSession.
  absl::Status OpenAgain();

  // Ends the session on the server.
  absl::Status Close() { return client_->CloseSession(session_id_); }

 private:
  Client* client_;
  std::string session_id_;
  int64_t step_;
  std::optional<v1::OpenSessionRequest> reopening_;  // absent: a lost session stays lost
  v1::OpenSessionResponse opening_;
  int reopened_ = 0;
};

}  // namespace spikeserve

#endif  // SPIKESERVE_REMOTE_SESSION_H_
