// The subcommands of spikectl.
//
// Each function adds one subcommand to `program`, with its flags and its action. The action calls
// the server and writes the result to standard output, or returns an error. `server` must live
// until Program::Run returns.
#pragma once

#include "client/spikectl/server_flags.h"
#include "core/cli/program.h"

namespace spikeserve {

// Lists all policy versions that the server serves.
void AddPoliciesCommand(Command program, const ServerFlags& server);

// Asks the server whether it is ready for sessions. Containers use it as their health check.
void AddHealthCommand(Command program, const ServerFlags& server);

// Plays episodes of an environment in this process with the decisions of the server.
void AddRunCommand(Command program, const ServerFlags& server);

// Shows the spikes, routing gates and attention of a decision.
void AddExplainCommand(Command program, const ServerFlags& server);

// Plays a perturbed environment with learning enabled, then greedily with the learned head.
void AddAdaptCommand(Command program, const ServerFlags& server);

// Replays a recorded session and fails at the first decision that differs.
void AddReplayCommand(Command program, const ServerFlags& server);

// Adds the commands that change policy files, without a server, as subcommands of `policy`.
void AddPolicyCommands(Command program);

// Tests whether a robot is wired right, by recordings or by a session of the server.
void AddDoctorCommand(Command program, const ServerFlags& server);

// Adds the commands that read a session store, without a server, as subcommands of `store`.
void AddStoreCommands(Command program, const ServerFlags& server);

// Writes a policy file as C for a microcontroller, without a server.
void AddEmitCommand(Command program, const ServerFlags& server);

// Adds the commands for operators: those that move files, and the others as subcommands of `admin`.
void AddAdminCommands(Command program, const ServerFlags& server);

// Adds the commands that hold robots: hold, resume and holds.
void AddHoldCommands(Command program, const ServerFlags& server);

// Acts in the place of a session's policy.
void AddTakeCommand(Command program, const ServerFlags& server);

}  // namespace spikeserve
