// The command line of a program: flags, subcommands, help, and the action that they select.
//
// A flag is given as --name=value or --name value. One that is not on the command line is taken
// from the environment variable PROGRAM_NAME (SPIKESERVE_LISTEN), then from the file that --config
// names, else it has its default. An empty variable counts as none.
//
//   int main(int argc, char** argv) {
//     spikeserve::ServerOptions options;
//     spikeserve::Program program("spikeserve", "Serves spiking policies over gRPC.");
//     program.root().Flags("Serving").Add("listen", "HOST:PORT", &options.listen, "Address");
//     program.root().SetAction([&] { return Serve(options); });
//     return program.Run(argc, argv);
//   }
//
// Not thread-safe. Declaring a name twice ends the process.
#ifndef CORE_CLI_PROGRAM_H_
#define CORE_CLI_PROGRAM_H_

#include <functional>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/cli/flag_group.h"

namespace spikeserve {

struct ProgramState;

// A program, or one of its subcommands. A handle; valid as long as its Program.
class Command {
 public:
  Command(CLI::App* app, ProgramState* state) : app_(app), state_(state) {}

  // Returns a new group of flags.
  FlagGroup Flags(const std::string& heading) const { return FlagGroup(app_, heading); }

  // Adds a subcommand. A command that has one has no action of its own. The program's flags may
  // stand behind the subcommand, too.
  Command AddCommand(const std::string& name, const std::string& summary) const;

  // What Program::Run does where the command line selects this command.
  void SetAction(std::function<absl::Status()> action) const;

  // Makes it an error to give a flag of the group `heading` on the command line beside --flag,
  // which leaves them without effect.
  void RefuseBeside(const std::string& flag, const std::string& heading) const;

 private:
  CLI::App* app_;
  ProgramState* state_;
};

// Whether errors end with the name of their code, as in "... (NOT_FOUND)".
enum class ErrorCodes { kHidden, kShown };

class Program {
 public:
  // `name` is that of the executable. Every program has --help, --version, --config and --generate,
  // which prints a completion script or the manual page.
  Program(const std::string& name, const std::string& summary,
          ErrorCodes error_codes = ErrorCodes::kHidden);
  ~Program();
  Program(const Program&) = delete;
  Program& operator=(const Program&) = delete;

  Command root();

  // Parses the arguments and runs the selected action. Prints an error as one line on standard
  // error. Returns the exit status, 0 or 1. REQUIRES: not called before.
  int Run(int argc, const char* const* argv);

  // Returns a command line that gives every flag which is set, wherever it was set. REQUIRES: an
  // action runs.
  std::string CommandLine() const;

 private:
  // Returns what --help, --version or --generate print; empty where an action is to run.
  absl::StatusOr<std::string> Parse(int argc, const char* const* argv);
  absl::Status CheckRefusals() const;

  std::unique_ptr<ProgramState> state_;
};

}  // namespace spikeserve

#endif  // CORE_CLI_PROGRAM_H_
