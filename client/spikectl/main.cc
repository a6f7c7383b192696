// spikectl: a client of spikeserve at the shell. Every subcommand has a file of its own.
#include "client/spikectl/commands.h"
#include "client/spikectl/server_flags.h"
#include "client/tools/default_server.h"
#include "core/cli/printable_output.h"
#include "core/cli/program.h"

int main(int argc, char** argv) {
  spikeserve::SilenceGrpc();
  const spikeserve::PrintableOutput output;
  spikeserve::ServerFlags server;
  spikeserve::Program program("spikectl",
                              "Plays, watches and administers policies of a spikeserve server",
                              spikeserve::ErrorCodes::kShown);
  const spikeserve::Command root = program.root();
  spikeserve::AddServerFlags(root, &server);
  spikeserve::AddPoliciesCommand(root, server);
  spikeserve::AddHealthCommand(root, server);
  spikeserve::AddRunCommand(root, server);
  spikeserve::AddExplainCommand(root, server);
  spikeserve::AddAdaptCommand(root, server);
  spikeserve::AddReplayCommand(root, server);
  spikeserve::AddAdminCommands(root, server);
  spikeserve::AddHoldCommands(root, server);
  spikeserve::AddTakeCommand(root, server);
  spikeserve::AddStoreCommands(root, server);
  spikeserve::AddEmitCommand(root, server);
  spikeserve::AddPolicyCommands(root);
  spikeserve::AddDoctorCommand(root, server);
  return program.Run(argc, argv);
}
