// One session of the server as its agent sees it: keeps the step, so that a repeated request is
// recognised.
//
// A RemoteSession is a pair of session id and step, nothing more. An agent that was restarted
// attaches to its old session with RemoteSession(&client, id, step): asking for the last answered
// step gets that answer again, byte for byte, and the episode goes on from there.
//
// Not thread-safe; several sessions may share one client from many threads.
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

// How an episode ended, in Gymnasium's terms.
struct EpisodeOutcome {
  double reward = 0.0;  // for the last action
  bool terminated = false;
  bool truncated = false;
  std::optional<double> target_return =
      std::nullopt;                     // for the next episode; unset: the session's own
  std::vector<float> observation = {};  // what the last action led to, for recordings
};

class RemoteSession {
 public:
  // `step` is that of the next request: one never asked for, or the last answered one again.
  // `client` must outlive the session.
  RemoteSession(Client* client, std::string session_id, int64_t step)
      : client_(client), session_id_(std::move(session_id)), step_(step) {}

  const std::string& session_id() const { return session_id_; }
  int64_t step() const { return step_; }

  // The decision at this step. `observation` in raw environment units; `reward` for the previous
  // action, ignored at step 0. Retries as Client::Act does; the step moves on only with an answer,
  // so after an error the same call may be made again. INTERNAL if the answer is for another
  // session or step.
  absl::StatusOr<v1::ActResponse> Act(absl::Span<const float> observation, double reward);

  // Act in two halves, for ActBatch and streams: the request of this step, and its answer.
  v1::ActRequest MakeRequest(absl::Span<const float> observation, double reward) const;
  absl::Status Accept(const v1::ActResponse& response);

  // Ends the episode; the next step is 0. See Client::EndEpisode for what an error means.
  absl::StatusOr<v1::EndEpisodeResponse> EndEpisode(const EpisodeOutcome& outcome);

  // Ends the session on the server.
  absl::Status Close() { return client_->CloseSession(session_id_); }

 private:
  Client* client_;
  std::string session_id_;
  int64_t step_;
};

}  // namespace spikeserve

#endif  // SPIKESERVE_REMOTE_SESSION_H_
