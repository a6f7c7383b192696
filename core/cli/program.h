// Parses the command line of a program and runs the action that it selects.
//
// A flag is given as --name=value or --name value. If it is not on the command line, it is read
// from the environment variable PROGRAM_NAME, for example SPIKESERVE_LISTEN, or else from the file
// of --config. Otherwise it has its default. A variable that is set but empty sets the empty value.
// A variable PROGRAM_... that belongs to no flag is an error, as an unknown key of the file is.
//
//   int main(int argc, char** argv) {
//     spikeserve::ServerOptions options;
//     spikeserve::Program program("spikeserve", "Serves spiking policies over gRPC.");
//     program.root().Flags("Serving").Add("listen", "HOST:PORT", &options.listen, "Address");
//     program.root().SetAction([&] { return Serve(options); });
//     return program.Run(argc, argv);
//   }
//
// Not thread-safe. Declaring the same flag or command twice ends the process.
#pragma once

#include <functional>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/cli/flag_group.h"

namespace spikeserve {

struct ProgramState;

// A handle to a program or to one of its subcommands. Valid as long as its Program.
class Command {
 public:
  Command(CLI::App* app, ProgramState* state) : app_(app), state_(state) {}

  // Adds a group of flags under `heading`. Only the manual describes the flags of a heading that
  // begins with "Advanced: ".
  FlagGroup Flags(const std::string& heading) const { return FlagGroup(app_, heading); }

  // Adds a subcommand. A command with subcommands has no action of its own. On the command line,
  // flags of the program may come before or after the subcommand.
  Command AddCommand(const std::string& name, const std::string& summary) const;

  // Sets the function that Program::Run calls if the command line selects this command.
  void SetAction(std::function<absl::Status()> action) const;

  // Leaves the command out of help, manual and completion, for old names.
  void Hide() const;

  // Makes it an error to combine --flag with a flag of the group `heading` on the command line, for
  // groups that have no effect together with --flag.
  void RefuseBeside(const std::string& flag, const std::string& heading) const;

 private:
  CLI::App* app_;
  ProgramState* state_;
};

// Selects whether printed errors end with the name of their status code, as in "... (NOT_FOUND)".
enum class ErrorCodes { kHidden, kShown };

class Program {
 public:
  // `name` is the name of the executable. Every program has the flags --help, --version, --config,
  // and --generate, which prints a completion script or the manual page.
  Program(const std::string& name, const std::string& summary,
          ErrorCodes error_codes = ErrorCodes::kHidden);
  ~Program();
  Program(const Program&) = delete;
  Program& operator=(const Program&) = delete;

  Command root();

  // Says that the environment variable `name`, which begins as those of flags do, belongs to
  // another program. Parsing refuses other variables of this form that belong to no flag.
  void AllowVariable(const std::string& name);

  // Parses the arguments and runs the selected action. Prints an error as one line to standard
  // error. Returns the exit status, 0 or 1. REQUIRES: called once.
  int Run(int argc, const char* const* argv);

  // Returns a command line with every flag that is set, also by the environment or by a file.
  // REQUIRES: called by an action.
  std::string CommandLine() const;

 private:
  // Returns the text that --help, --version or --generate print, or an empty string if an action
  // was selected.
  absl::StatusOr<std::string> Parse(int argc, const char* const* argv);
  absl::Status CheckRefusals() const;

  std::unique_ptr<ProgramState> state_;
};

}  // namespace spikeserve
