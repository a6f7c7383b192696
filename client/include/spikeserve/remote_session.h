// One session of an agent on the server. Counts the steps, so that the server recognises repeated
// requests.
//
//   auto session = RemoteSession::Open(client.get(), request);
//   auto answer = session->Act(observation, reward);
//   session->EndEpisode({.reward = last_reward, .terminated = true});
//
// A restarted agent continues its session with RemoteSession(&client, id, step): repeating the last
// answered step returns the same answer, byte for byte, and the episode continues from there.
//
// A session that is opened with Open and is stored (opening().durability() is ASYNC or SYNC)
// outlives its server. It keeps the requests that the store may not have yet, and sends them again
// to the server that continues with the session. Calls return DATA_LOSS (DivergedAt) once if one of
// them gets another answer than before.
//
// Not thread-safe. Several sessions may share one client from many threads.
#ifndef SPIKESERVE_REMOTE_SESSION_H_
#define SPIKESERVE_REMOTE_SESSION_H_

#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/functional/function_ref.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/types/span.h"
#include "spikeserve/client.h"
#include "spikeserve/executed_action.h"
#include "spikeserve/feature_order.h"
#include "spikeserve/unacknowledged.h"

namespace spikeserve {

// The end of an episode, in the terms of Gymnasium.
struct EpisodeOutcome {
  double reward = 0.0;  // for the last action
  bool terminated = false;
  bool truncated = false;
  std::optional<double> target_return =
      std::nullopt;                     // of the next episode; unset: as the session was opened
  std::vector<float> observation = {};  // after the last action; used by recordings only
  // The executed last action, if it differs from the answered one, or another one chose it.
  std::optional<ExecutedAction> executed_action = std::nullopt;
};

class RemoteSession {
 public:
  // Opens a session. If `reopens`, a session that the server has lost (IsSessionLost) is replaced
  // by a new one with the same request: Act then decides at step 0 of its first episode, and what
  // the lost session remembered and learned is gone. EndEpisode still returns the error, because
  // the totals of the episode are lost. The calls of the session take the way of `route`, or one of
  // their own. `client` must outlive the session. If `request` names the robot's elements, the
  // session takes observations and returns actions in the robot's order, whatever the policy's is.
  static absl::StatusOr<RemoteSession> Open(Client* client, v1::OpenSessionRequest request,
                                            bool reopens = false,
                                            std::shared_ptr<Route> route = nullptr);

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
      const std::optional<ExecutedAction>& executed_action = std::nullopt);

  // Act in two parts, for ActBatch and ActAsync. MakeRequest returns the request of this step;
  // Accept takes the answer to the last one and advances the step, with the errors of Act.
  v1::ActRequest MakeRequest(absl::Span<const float> observation, double reward,
                             const std::optional<ExecutedAction>& executed_action = std::nullopt);
  absl::Status Accept(const v1::ActResponse& response);
  // Puts the action of an accepted answer in the order of the robot that named its elements. Act
  // and streams with a session have done it.
  void ToRobot(v1::ActResponse* response) { order_.ToRobot(response); }

  // Brings a server up to date that does not have all decisions of the session, as `error` of such
  // a request says (ExpectedDecision): sends again what it misses. Returns OK if the request may
  // then be sent again, and `error` if there is nothing to send. Act and the other calls of this
  // class, and streams, do this by themselves.
  absl::Status CatchUp(const absl::Status& error);

  // Ends the episode and sets the step to 0. On an error the step stays. Errors: see Client.
  absl::StatusOr<v1::EndEpisodeResponse> EndEpisode(const EpisodeOutcome& outcome);

  // Return the state of the session on the server, and its last decision from the inside, as the
  // methods of Client, but never from a server that does not have all decisions.
  absl::StatusOr<v1::GetSessionResponse> State(bool include_head_delta = false);
  absl::StatusOr<v1::ExplainResponse> Explain();

  // The response to the request that opened the session; empty if it was not opened by Open.
  const v1::OpenSessionResponse& opening() const { return opening_; }
  // Returns whether a lost session is replaced by a new one.
  bool reopens() const { return reopening_.has_value(); }
  // Returns how often a lost session was replaced by a new one.
  int reopened() const { return reopened_; }

  // Replaces a lost session by a new one. Returns FAILED_PRECONDITION if the session does not
  // reopen, and the errors of Client::OpenSession.
  absl::Status OpenAgain();

  // Ends the session on the server. Returns OK if it was lost.
  absl::Status Close() {
    const absl::Status status = client_->CloseSession(session_id_, route_);
    return absl::IsNotFound(status) ? absl::OkStatus() : status;
  }

  // The way of the calls of the session; null: that of its id.
  const std::shared_ptr<Route>& route() const { return route_; }

 private:
  friend class RemoteStream;

  // Makes `call` until the server has all decisions. Returns its last result.
  template <typename Response>
  absl::StatusOr<Response> CallUpToDate(absl::FunctionRef<absl::StatusOr<Response>()> call,
                                        bool reads = false);
  // Act, for a request of MakeRequest.
  absl::StatusOr<v1::ActResponse> Decide(const v1::ActRequest& request);
  absl::Status CatchUp(const absl::Status& error, bool reads);
  // MakeRequest, of an observation and an action in the policy's order.
  v1::ActRequest MakeOrdered(absl::Span<const float> observation, double reward,
                             const std::optional<ExecutedAction>& executed_action);

  Client* client_;
  std::string session_id_;
  int64_t step_;
  std::shared_ptr<Route> route_;
  // The number of the next decision, and of the episode. Absent if the session was not opened here.
  std::optional<uint64_t> decision_;
  std::optional<int64_t> episode_;
  bool is_stored_ = false;                           // whether a store has the session
  Unacknowledged unacknowledged_;                    // empty if not stored
  v1::ActRequest request_;                           // the last one; empty if not stored
  std::optional<v1::OpenSessionRequest> reopening_;  // absent: a lost session stays lost
  v1::OpenSessionResponse opening_;
  FeatureOrder order_;
  int reopened_ = 0;
};

}  // namespace spikeserve

#endif  // SPIKESERVE_REMOTE_SESSION_H_
