// One ActStream call, which carries the requests of any number of sessions.
//
//   auto stream = client->OpenStream();
//   stream->Send(session.MakeRequest(observation, reward));
//   auto reply = stream->Receive(absl::Seconds(5));
//
// Send does not wait for the server, so one thread can serve many sessions. Unsent requests are
// buffered without limit. The replies of one session come in the order of its requests.
//
// Thread-safe.
#ifndef SPIKESERVE_REMOTE_STREAM_H_
#define SPIKESERVE_REMOTE_STREAM_H_

#include <chrono>
#include <cstdint>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "spikeserve/v1/policy_service.grpc.pb.h"

namespace spikeserve {

// The answer to one request.
struct ActReply {
  std::string session_id;
  int64_t step = 0;
  absl::StatusOr<v1::ActResponse> response;  // or the error of this request; the stream stays open
  std::chrono::steady_clock::time_point arrived;  // when it reached this process
};

class RemoteStream {
 public:
  explicit RemoteStream(v1::PolicyService::Stub& stub);
  // Cancels the call if it has not ended, and blocks until gRPC has finished it.
  ~RemoteStream();

  RemoteStream(const RemoteStream&) = delete;
  RemoteStream& operator=(const RemoteStream&) = delete;

  // Queues one request. Returns the status of the call if the call has ended, and
  // FAILED_PRECONDITION after CloseSend.
  absl::Status Send(const v1::ActRequest& request);

  // Returns the next reply of any session. Returns DEADLINE_EXCEEDED if none arrives within
  // `timeout`; the stream stays open. After the call has ended and all replies were returned,
  // returns the status of the call, or OUT_OF_RANGE if that is OK. Requests without a reply may
  // then be sent again, with the same steps, on another stream.
  absl::StatusOr<ActReply> Receive(absl::Duration timeout);

  // Declares that no more requests follow. The server answers the pending ones and ends the call.
  void CloseSend();

 private:
  class Call;
  const std::unique_ptr<Call> call_;
};

}  // namespace spikeserve

#endif  // SPIKESERVE_REMOTE_STREAM_H_
