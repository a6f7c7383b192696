// The actions of `spikectl admin` about roll-outs, and the history of operators' actions.
#ifndef CLIENT_SPIKECTL_ROLLOUT_ACTIONS_H_
#define CLIENT_SPIKECTL_ROLLOUT_ACTIONS_H_

#include "absl/status/status.h"
#include "client/spikectl/admin_call.h"

namespace spikeserve {

// Starts a roll-out, or ends the running one if --abort is set.
absl::StatusOr<Answer> ChangeRollout(const AdminFlags& flags);

// Shows the last roll-out of every policy.
absl::StatusOr<Answer> ShowRollouts(const AdminFlags& flags);

// Shows who changed what.
absl::StatusOr<Answer> ShowHistory(const AdminFlags& flags);

}  // namespace spikeserve

#endif  // CLIENT_SPIKECTL_ROLLOUT_ACTIONS_H_
