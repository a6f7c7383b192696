// Checks the environment variables of a program.
#ifndef CORE_CLI_ENVIRONMENT_H_
#define CORE_CLI_ENVIRONMENT_H_

#include <CLI/CLI.hpp>
#include <string>
#include <vector>

#include "absl/status/status.h"

namespace spikeserve {

// Returns INVALID_ARGUMENT if a variable PROGRAM_... is set that belongs to no flag of `root` or
// its subcommands and is not one of `others`. Ignores the variables that Kubernetes sets for a
// service of the program's name, such as SPIKESERVE_PORT_50051_TCP, and those that name the
// programs to the tests of this repository, such as SPIKESERVE_PROGRAM. REQUIRES: the options know
// their variables.
absl::Status CheckVariables(const CLI::App& root, const std::vector<std::string>& others);

}  // namespace spikeserve

#endif  // CORE_CLI_ENVIRONMENT_H_
