// The subcommands of spikectl.
//
// Each function adds one to `program`: its flags, and an action that calls the server, writes its
// result to standard output and returns why it failed. `server` must live until Program::Run
// returns.
#ifndef CLIENT_SPIKECTL_COMMANDS_H_
#define CLIENT_SPIKECTL_COMMANDS_H_

#include "client/spikectl/server_flags.h"
#include "core/cli/program.h"

namespace spikeserve {

// Lists every policy version served.
void AddPoliciesCommand(Command program, const ServerFlags& server);

// Plays episodes of an environment that is stepped here, with the decisions of the server.
void AddRunCommand(Command program, const ServerFlags& server);

// Shows a decision from the inside.
void AddExplainCommand(Command program, const ServerFlags& server);

// Plays a perturbed environment with learning on, then greedily with the learned head.
void AddAdaptCommand(Command program, const ServerFlags& server);

// Plays a recorded session again and fails at the first decision that differs.
void AddReplayCommand(Command program, const ServerFlags& server);

// What an operator does, each a subcommand of `admin`.
void AddAdminCommands(Command program, const ServerFlags& server);

}  // namespace spikeserve

#endif  // CLIENT_SPIKECTL_COMMANDS_H_
