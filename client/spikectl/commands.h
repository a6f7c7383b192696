// The sub-commands of spikectl. Each reads its own flags, writes its result to standard output, and
// returns why it failed.
#ifndef CLIENT_SPIKECTL_COMMANDS_H_
#define CLIENT_SPIKECTL_COMMANDS_H_

#include "absl/status/status.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

// What an operator does; an `action` that there is not is answered with those that there are.
absl::Status AdminCommand(absl::string_view action);

// Lists every policy version served.
absl::Status PoliciesCommand();

// Plays episodes of an environment that is stepped here, with the decisions of the server.
absl::Status RunCommand();

// Shows a decision from the inside.
absl::Status ExplainCommand();

// Plays a perturbed environment with learning on, then greedily with the learned head.
absl::Status AdaptCommand();

// Plays a recorded session again and fails at the first decision that differs.
absl::Status ReplayCommand();

}  // namespace spikeserve

#endif  // CLIENT_SPIKECTL_COMMANDS_H_
