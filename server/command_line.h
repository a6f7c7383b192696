// The command line of spikeserve. Apart from its main function, which has no headers to compile.
#pragma once

namespace spikeserve {

// Serves until SIGTERM or SIGINT. Returns the exit status of the program.
int RunServer(int argc, char** argv);

}  // namespace spikeserve
