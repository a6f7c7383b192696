// The parts of Program that only program.cc puts together: files, variables, errors and texts.
//
// Functions have no shared state and are safe to call from many threads; an object belongs to one.
#pragma once

#include <CLI/CLI.hpp>
#include <istream>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "core/cli/command_tree.h"

namespace spikeserve {

// Reads TOML or INI files with lines `flag = value`. The flags of a subcommand are in a section
// [command] or [command.subcommand]. A key that is not a flag is an error. Skips flags that are
// also set by the environment, because in CLI11 the file has priority over the environment.
class ConfigFile final : public CLI::ConfigBase {
 public:
  // `root` must outlive this.
  explicit ConfigFile(CLI::App* root) : root_(root) {}

  // Throws CLI::ConfigError with a message that contains the expected and the received value.
  std::vector<CLI::ConfigItem> from_config(std::istream& input) const override;

 private:
  CLI::App* const root_;
};

// Returns INVALID_ARGUMENT if a variable PROGRAM_... is set that belongs to no flag of `root` or
// its subcommands and is not one of `others`. Ignores the variables that Kubernetes sets for a
// service of the program's name, such as SPIKESERVE_PORT_50051_TCP, and those that name the
// programs to the tests of this repository, such as SPIKESERVE_PROGRAM. REQUIRES: the options know
// their variables.
absl::Status CheckVariables(const CLI::App& root, const std::vector<std::string>& others);

// CLI11's format with two changes: the default of a flag follows its help in brackets, and the help
// of a subcommand also lists the flags of the program, because the subcommand accepts them.
class HelpFormat final : public CLI::Formatter {
 public:
  HelpFormat();

  std::string make_help(const CLI::App* app, std::string name,
                        CLI::AppFormatMode mode) const override;
  std::string make_usage(const CLI::App* app, std::string name) const override;
  std::string make_option_opts(const CLI::Option* option) const override;
  std::string make_option_desc(const CLI::Option* option) const override;

 private:
  std::string MakeFlags(const CLI::App* app) const;
};

// Returns the subcommand that the command line selected, or `root` if it selected none.
const CLI::App& SelectedCommand(const CLI::App& root);

// Returns INVALID_ARGUMENT with a message of one line, "--flag: expected X, received Y". The
// message also names the environment variable or the file of the invalid value, if it came from
// one. `error` is what `root` has thrown.
absl::Status StatusFromParseError(const CLI::App& root, const CLI::ParseError& error);

// Return a script that completes commands, flags, and the values of flags that are one of several
// words, a file or a directory. In zsh and fish it also shows the help of commands and flags.
std::string BashCompletion(const CommandInfo& program);
std::string ZshCompletion(const CommandInfo& program);
std::string FishCompletion(const CommandInfo& program);

// Returns a page of section 1 in the man(7) language. Its date is the current date, or the date in
// the environment variable SOURCE_DATE_EPOCH, which makes builds reproducible.
std::string ManualPage(const CommandInfo& program);

}  // namespace spikeserve
