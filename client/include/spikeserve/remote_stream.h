// One stream of decisions, which carries the requests of any number of sessions.
//
//   auto stream = client->OpenStream();
//   stream->Send(&session, observation, reward);
//   auto reply = stream->Receive(absl::Seconds(5));  // reply->response is the answer of the
//   session
//
// Send does not wait for the server, so one thread can serve many sessions. Unsent requests are
// buffered without limit. The replies of one session come in the order of its requests.
//
// If the connection breaks, Receive opens another call and sends the requests without an answer
// again, as long as ClientOptions::retry allows; then the stream is broken, and the next Send opens
// another call. With RetryOptions::max_attempts = 1 a broken stream stays broken. With several
// servers, the next call goes to another one, and so do all calls of the sessions of the stream.
//
// Thread-safe, except that nothing else may use a session while it has a request under way.
#ifndef SPIKESERVE_REMOTE_STREAM_H_
#define SPIKESERVE_REMOTE_STREAM_H_

#include <chrono>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "absl/types/span.h"
#include "spikeserve/executed_action.h"
#include "spikeserve/retry.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

class Client;
class OpenRequests;
class RemoteSession;
class StreamCall;
struct OpenRequest;
struct Replica;
struct Route;

// The answer to one request.
struct ActReply {
  std::string session_id;
  int64_t step = 0;
  absl::StatusOr<v1::ActResponse> response;  // or the error of this request; the stream stays open
  std::chrono::steady_clock::time_point arrived;  // when it reached this process
  RemoteSession* session = nullptr;               // of the request, if it was sent with one
};

class RemoteStream {
 public:
  // `client` must outlive the stream. Client::OpenStream makes one.
  RemoteStream(Client* client, std::shared_ptr<Route> route);
  // Cancels the call if it has not ended, and blocks until gRPC has finished it.
  ~RemoteStream();

  RemoteStream(const RemoteStream&) = delete;
  RemoteStream& operator=(const RemoteStream&) = delete;

  // The way of the calls of the stream, for RemoteSession::Open.
  const std::shared_ptr<Route>& route() const { return route_; }

  // Sends a request for the decision at the step of `session`, which must live until its reply. The
  // arguments are those of RemoteSession::Act. Receive advances the session, repeats the request if
  // the server cannot answer it now, and makes a call of its own for it where the session has to be
  // found or brought up to date. All calls of the session go to the server of the stream from now
  // on. Returns INVALID_ARGUMENT if the session has a request under way or exists at another server
  // only, FAILED_PRECONDITION after CloseSend, and the status of a stream that stays broken.
  absl::Status Send(RemoteSession* session, absl::Span<const float> observation, double reward,
                    const std::optional<ExecutedAction>& executed_action = std::nullopt);

  // Sends a request without its session. Its reply is returned as it is. Several requests of one
  // session may be under way; if the stream breaks then, the server may refuse those that it has
  // answered before the last one. Errors as above.
  absl::Status Send(const v1::ActRequest& request) ABSL_LOCKS_EXCLUDED(mutex_);

  // Returns the next reply of any session. Returns DEADLINE_EXCEEDED if none arrives within
  // `timeout`; the stream stays open. After CloseSend, when all replies were returned, returns
  // OUT_OF_RANGE. Returns the status of the call if the stream is broken: no request is under way
  // then, and each one may be sent again.
  absl::StatusOr<ActReply> Receive(absl::Duration timeout) ABSL_LOCKS_EXCLUDED(mutex_);

  // Declares that no more requests follow. The server answers the pending ones and ends the call.
  void CloseSend() ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  absl::Status Send(RemoteSession* session, v1::ActRequest request)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Opens a call at the preferred server, and sends all requests on it.
  void Start() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  bool MayReopen() const;
  // Plans another call after `error`, or declares the stream broken.
  void Break(const absl::Status& error) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Does what is due. Returns the time until which to wait for a reply, by the monotonic clock.
  absl::Duration Advance(absl::Duration deadline) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Handles the end of the call, or a silence that is too long. Returns a status if the stream has
  // ended, else OK.
  absl::Status TakeEnd(const absl::Status& end) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Returns the reply for a response. Sets `find` to the request if a call of its own has to answer
  // it. Returns nothing if the request is sent again later.
  std::optional<absl::StatusOr<ActReply>> TakeResponse(
      v1::ActResponse response, std::chrono::steady_clock::time_point arrived, v1::ActRequest* find)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Returns true if `request`, which failed with `error`, is sent again later.
  bool Postpone(const absl::Status& error, OpenRequest* request)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  Client* const client_;
  const std::shared_ptr<Route> route_;
  absl::Mutex mutex_;
  std::shared_ptr<StreamCall> call_ ABSL_GUARDED_BY(mutex_);
  Replica* replica_ ABSL_GUARDED_BY(mutex_) = nullptr;  // the server of the call
  const std::unique_ptr<OpenRequests> open_ ABSL_PT_GUARDED_BY(mutex_);
  std::optional<RetrySchedule> schedule_ ABSL_GUARDED_BY(mutex_);  // absent: the stream is whole
  // By the monotonic clock; absent: the call is open.
  std::optional<absl::Duration> reopens_at_ ABSL_GUARDED_BY(mutex_);
  std::optional<absl::Status> broken_ ABSL_GUARDED_BY(mutex_);
  // When the connection was last put in doubt, by the monotonic clock.
  absl::Duration doubted_ ABSL_GUARDED_BY(mutex_) = -absl::InfiniteDuration();
  bool send_closed_ ABSL_GUARDED_BY(mutex_) = false;
};

}  // namespace spikeserve

#endif  // SPIKESERVE_REMOTE_STREAM_H_
