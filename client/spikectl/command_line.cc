#include "client/spikectl/command_line.h"

#include "client/spikectl/commands.h"
#include "client/spikectl/server_flags.h"
#include "client/tools/default_server.h"
#include "core/cli/printable_output.h"
#include "core/cli/program.h"

namespace spikeserve {

int RunClient(int argc, char** argv) {
  SilenceGrpc();
  const PrintableOutput output;
  ServerFlags server;
  Program program("spikectl", "Plays, watches and administers policies of a spikeserve server",
                  ErrorCodes::kShown);
  const Command root = program.root();
  AddServerFlags(root, &server);
  AddPoliciesCommand(root, server);
  AddHealthCommand(root, server);
  AddRunCommand(root, server);
  AddExplainCommand(root, server);
  AddAdaptCommand(root, server);
  AddReplayCommand(root, server);
  AddAdminCommands(root, server);
  AddHoldCommands(root, server);
  AddTakeCommand(root, server);
  AddStoreCommands(root, server);
  AddEmitCommand(root, server);
  AddPolicyCommands(root);
  AddDoctorCommand(root, server);
  return program.Run(argc, argv);
}

}  // namespace spikeserve
