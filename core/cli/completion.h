// Generates scripts that complete the command line of a program in a shell.
//
// Free functions without shared state; safe to call from many threads.
#ifndef CORE_CLI_COMPLETION_H_
#define CORE_CLI_COMPLETION_H_

#include <string>

#include "core/cli/command_tree.h"

namespace spikeserve {

// Return a script that completes commands, flags, and the values of flags that are one of several
// words, a file or a directory. In zsh and fish it also shows the help of commands and flags.
std::string BashCompletion(const CommandInfo& program);
std::string ZshCompletion(const CommandInfo& program);
std::string FishCompletion(const CommandInfo& program);

}  // namespace spikeserve

#endif  // CORE_CLI_COMPLETION_H_
