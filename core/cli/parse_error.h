// Converts an error of CLI11 to a status.
#ifndef CORE_CLI_PARSE_ERROR_H_
#define CORE_CLI_PARSE_ERROR_H_

#include <CLI/CLI.hpp>

#include "absl/status/status.h"

namespace spikeserve {

// Returns the subcommand that the command line selected, or `root` if it selected none.
const CLI::App& SelectedCommand(const CLI::App& root);

// Returns INVALID_ARGUMENT with a message of one line, "--flag: expected X, received Y". The
// message also names the environment variable or the file of the invalid value, if it came from
// one. `error` is what `root` has thrown.
absl::Status StatusFromParseError(const CLI::App& root, const CLI::ParseError& error);

}  // namespace spikeserve

#endif  // CORE_CLI_PARSE_ERROR_H_
