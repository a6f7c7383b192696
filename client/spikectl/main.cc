// spikectl: a client of spikeserve at the shell. Every subcommand has a file of its own.
#include "client/spikectl/command_line.h"

int main(int argc, char** argv) { return spikeserve::RunClient(argc, argv); }
