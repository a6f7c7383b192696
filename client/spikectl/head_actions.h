// The actions of `spikectl admin` for learning and the shared head. Each action makes one call,
// prints the answer, and returns the error of the call.
#ifndef CLIENT_SPIKECTL_HEAD_ACTIONS_H_
#define CLIENT_SPIKECTL_HEAD_ACTIONS_H_

#include "absl/status/status.h"
#include "client/spikectl/admin_call.h"

namespace spikeserve {

absl::StatusOr<Answer> ShowHead(const AdminFlags& flags);
absl::StatusOr<Answer> PromoteHead(const AdminFlags& flags);
absl::StatusOr<Answer> RollbackHead(const AdminFlags& flags);
absl::StatusOr<Answer> PauseLearning(const AdminFlags& flags);
absl::StatusOr<Answer> ResumeLearning(const AdminFlags& flags);

}  // namespace spikeserve

#endif  // CLIENT_SPIKECTL_HEAD_ACTIONS_H_
