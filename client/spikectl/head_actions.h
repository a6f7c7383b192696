// What `spikectl admin` does about what sessions learn. Each makes its call with the flags and
// prints the answer; an error is the call's.
#ifndef CLIENT_SPIKECTL_HEAD_ACTIONS_H_
#define CLIENT_SPIKECTL_HEAD_ACTIONS_H_

#include "absl/status/status.h"
#include "client/spikectl/admin_call.h"

namespace spikeserve {

absl::Status ShowHead(const AdminFlags& flags);
absl::Status PromoteHead(const AdminFlags& flags);
absl::Status RollbackHead(const AdminFlags& flags);
absl::Status PauseLearning(const AdminFlags& flags);
absl::Status ResumeLearning(const AdminFlags& flags);

}  // namespace spikeserve

#endif  // CLIENT_SPIKECTL_HEAD_ACTIONS_H_
