// What `spikectl admin` does about what sessions learn. Each makes its call with the flags and
// prints the answer; an error is the call's.
#ifndef CLIENT_SPIKECTL_HEAD_ACTIONS_H_
#define CLIENT_SPIKECTL_HEAD_ACTIONS_H_

#include "absl/status/status.h"

namespace spikeserve {

absl::Status ShowHead();
absl::Status PromoteHead();
absl::Status RollbackHead();
absl::Status PauseLearning();
absl::Status ResumeLearning();

}  // namespace spikeserve

#endif  // CLIENT_SPIKECTL_HEAD_ACTIONS_H_
