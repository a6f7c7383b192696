// Turns an error of CLI11 into a status.
#ifndef CORE_CLI_PARSE_ERROR_H_
#define CORE_CLI_PARSE_ERROR_H_

#include <CLI/CLI.hpp>

#include "absl/status/status.h"

namespace spikeserve {

// Returns the command that the command line selected, as far as there was one.
const CLI::App& SelectedCommand(const CLI::App& root);

// Returns INVALID_ARGUMENT with a message of one line, "--flag: expected X, received Y", which also
// names the variable or the file that a wrong value came from. `root` has thrown `error`.
absl::Status StatusFromParseError(const CLI::App& root, const CLI::ParseError& error);

}  // namespace spikeserve

#endif  // CORE_CLI_PARSE_ERROR_H_
