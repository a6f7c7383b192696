// spikeserve: serves spiking policies over gRPC.
//
// Prints one line per endpoint on standard output once it serves, logs to standard error, and stops
// gracefully on SIGTERM or SIGINT.
#include "server/command_line.h"

int main(int argc, char** argv) { return spikeserve::RunServer(argc, argv); }
