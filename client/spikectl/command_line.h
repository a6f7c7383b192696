// The command line of spikectl. Apart from its main function, which has no headers to compile.
#pragma once

namespace spikeserve {

// Runs the command that the arguments name. Returns the exit status of the program.
int RunClient(int argc, char** argv);

}  // namespace spikeserve
