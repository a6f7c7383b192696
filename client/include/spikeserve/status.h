// Converts gRPC statuses to absl::Status. Keeps the code, the message, the time of the next try and
// the expected decision that the server sent.
//
// Free functions, safe to call from many threads.
#ifndef SPIKESERVE_STATUS_H_
#define SPIKESERVE_STATUS_H_

#include <grpcpp/support/status.h>

#include <cstdint>
#include <optional>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"

namespace spikeserve {

// Converts the status of a call.
absl::Status StatusFromGrpc(const grpc::Status& status);

// Converts the status of one item of a batch or a stream. `code` is the number of a gRPC status
// code; any other number becomes UNKNOWN. `retry_after_seconds`, `expected_decision` and
// `expected_episode` are those of the item, if it has them.
absl::Status StatusFromCode(int32_t code, absl::string_view message,
                            std::optional<double> retry_after_seconds = std::nullopt,
                            std::optional<uint64_t> expected_decision = std::nullopt,
                            std::optional<int64_t> expected_episode = std::nullopt);

// Returns the time after which the server expects that the call may succeed, if it named one
// (google.rpc.RetryInfo).
std::optional<absl::Duration> RetryAfter(const absl::Status& status);

// Returns the number of the decision that the session expects, if the request was out of order and
// the server said so.
std::optional<uint64_t> ExpectedDecision(const absl::Status& status);

// Returns the index of the episode of that decision, if the server has named it.
std::optional<int64_t> ExpectedEpisode(const absl::Status& status);

// Returns the number of the decision if `status` says that a request, which was sent again after
// the loss of a server, got another answer than before. For the end of an episode: the number of
// the decision that follows. The session continues from the new answer.
std::optional<uint64_t> DivergedAt(const absl::Status& status);

// Returns DATA_LOSS, for which DivergedAt returns `decision`.
absl::Status DivergedError(absl::string_view session_id, uint64_t decision);

// Returns whether the server does not know the session of the call any more, because it was
// restarted or has ended the session.
bool IsSessionLost(const absl::Status& status);

// Returns `status` of a call that names a session: a NOT_FOUND becomes one for which IsSessionLost
// returns true, because a session is all that such a call can fail to find.
absl::Status ForSession(absl::Status status);

}  // namespace spikeserve

#endif  // SPIKESERVE_STATUS_H_
