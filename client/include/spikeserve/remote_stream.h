// One ActStream call: any number of sessions multiplexed on one stream.
//
// Send never waits for the server, so a single thread can keep many sessions going: what the caller
// has sent and not yet had answered is buffered here. Replies of one session come in the order of
// its requests.
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
  absl::StatusOr<v1::ActResponse> response;       // or why this request failed; the stream goes on
  std::chrono::steady_clock::time_point arrived;  // when it reached this process
};

class RemoteStream {
 public:
  explicit RemoteStream(v1::PolicyService::Stub& stub);
  // Cancels the call if it has not ended.
  ~RemoteStream();

  RemoteStream(const RemoteStream&) = delete;
  RemoteStream& operator=(const RemoteStream&) = delete;

  // Queues one request. If the call has ended: its status, or FAILED_PRECONDITION after CloseSend.
  absl::Status Send(const v1::ActRequest& request);

  // The next reply of any session. DEADLINE_EXCEEDED if none came within `timeout` (the stream goes
  // on); once the call has ended and every reply was taken, its status, or OUT_OF_RANGE if that is
  // OK. Requests without a reply may then be sent again, with the same steps, on another stream.
  absl::StatusOr<ActReply> Receive(absl::Duration timeout);

  // No more requests: the server answers what it has and ends the call.
  void CloseSend();

 private:
  class Call;
  const std::unique_ptr<Call> call_;
};

}  // namespace spikeserve

#endif  // SPIKESERVE_REMOTE_STREAM_H_
