// spikectl: a client of spikeserve at the shell. Every sub-command has a file of its own.
#include <iostream>
#include <string>
#include <vector>

#include "absl/flags/parse.h"
#include "absl/flags/usage.h"
#include "absl/flags/usage_config.h"
#include "absl/status/status.h"
#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "client/spikectl/commands.h"
#include "client/spikectl/common_flags.h"

namespace spikeserve {
namespace {

struct Command {
  const char* name;
  const char* summary;
  const char* flags;  // beside those that every command has
  absl::Status (*run)();
};

constexpr Command kCommands[] = {
    {"policies", "list every policy version served", "", PoliciesCommand},
    {"run", "play episodes of an environment stepped here, acting over gRPC",
     "env policy version target_return seed episodes record", RunCommand},
    {"explain", "show a session's last decision from the inside",
     "session env policy version target_return seed steps", ExplainCommand},
    {"adapt",
     "play a task whose physics have changed with learning on, then judge the learned head",
     "env policy version target_return seed episodes perturb rule modulator scope fleet "
     "temperature learning_rate discount",
     AdaptCommand},
    {"replay", "play a recorded session again and compare every decision, bit for bit",
     "recording policy version", ReplayCommand},
};

std::string Usage() {
  std::string usage = "spikectl COMMAND [--flag=value ...]\n\nCommands:\n";
  for (const Command& command : kCommands) {
    absl::StrAppend(&usage, "  ", command.name, ": ", command.summary, ListFlags(command.flags),
                    "\n");
  }
  absl::StrAppend(
      &usage, "  admin ACTION: what an operator does: load, unload, default, label, ",
      "unlabel, traffic, reload, sessions, drain, head, promote, rollback, pause, resume\n");
  return usage;
}

absl::Status Dispatch(const std::vector<char*>& arguments) {
  const std::string names =
      absl::StrJoin(kCommands, ", ",
                    [](std::string* out, const Command& c) { out->append(c.name); }) +
      ", admin";
  if (arguments.size() < 2) {
    return absl::InvalidArgumentError(absl::StrCat("command: expected one of ", names));
  }
  if (arguments[1] == absl::string_view("admin") && arguments.size() <= 3) {
    return AdminCommand(arguments.size() == 3 ? arguments[2] : "");
  }
  for (const Command& command : kCommands) {
    if (arguments[1] != absl::string_view(command.name)) continue;
    if (arguments.size() > 2) {
      return absl::InvalidArgumentError(
          absl::StrCat(command.name, ": expected flags alone, received \"", arguments[2], "\""));
    }
    if (auto status = CheckFlags(command.name, command.flags); !status.ok()) return status;
    return command.run();
  }
  return absl::InvalidArgumentError(
      absl::StrCat("command: expected one of ", names, ", received \"", arguments[1], "\""));
}

}  // namespace
}  // namespace spikeserve

int main(int argc, char** argv) {
  absl::SetProgramUsageMessage(spikeserve::Usage());
  absl::FlagsUsageConfig usage;
  usage.contains_help_flags = [](absl::string_view file) {
    return absl::StrContains(file, "client/");
  };
  absl::SetFlagsUsageConfig(usage);
  const absl::Status status = spikeserve::Dispatch(absl::ParseCommandLine(argc, argv));
  if (status.ok()) return 0;
  std::cerr << "spikectl: " << status.message() << " (" << absl::StatusCodeToString(status.code())
            << ")\n";
  return 1;
}
