#include "core/cli/command_tree.h"

#include <CLI/CLI.hpp>

#include "absl/algorithm/container.h"
#include "absl/strings/match.h"
#include "absl/strings/str_join.h"
#include "absl/strings/str_split.h"

namespace spikeserve {
namespace {

FlagInfo DescribeFlag(const CLI::Option& option) {
  const bool takes_value = option.get_expected_max() > 0;
  return {.name = option.get_lnames().front(),
          .heading = option.get_group(),
          .kind = takes_value ? option.get_type_name() : "",
          .default_text = option.get_default_str(),
          .help = option.get_description()};
}

CommandInfo Describe(const CLI::App& app, std::vector<std::string> path) {
  path.push_back(app.get_name());
  CommandInfo command;
  command.path = std::move(path);
  command.summary = app.get_description();
  for (const CLI::Option* option : app.get_options({})) {
    if (!option->get_group().empty()) command.flags.push_back(DescribeFlag(*option));
  }
  for (const CLI::App* subcommand : app.get_subcommands({})) {
    if (subcommand->get_group().empty()) continue;
    command.commands.push_back(Describe(*subcommand, command.path));
  }
  return command;
}

}  // namespace

std::vector<std::string> FlagInfo::choices() const {
  if (!absl::StrContains(kind, '|')) return {};
  return absl::StrSplit(kind, '|');
}

std::string CommandInfo::SubPath(const std::string& separator) const {
  return absl::StrJoin(path.begin() + 1, path.end(), separator);
}

CommandInfo DescribeCommands(const CLI::App& app) { return Describe(app, {}); }

std::vector<FlagInfo> AcceptedFlags(const CommandInfo& program, const CommandInfo& command) {
  std::vector<FlagInfo> flags = command.flags;
  if (&command == &program) return flags;
  for (const FlagInfo& flag : program.flags) {
    const bool is_hidden =
        absl::c_any_of(command.flags, [&](const FlagInfo& own) { return own.name == flag.name; });
    if (!is_hidden) flags.push_back(flag);
  }
  return flags;
}

std::vector<const CommandInfo*> AllCommands(const CommandInfo& command) {
  std::vector<const CommandInfo*> all = {&command};
  for (const CommandInfo& subcommand : command.commands) {
    const std::vector<const CommandInfo*> below = AllCommands(subcommand);
    all.insert(all.end(), below.begin(), below.end());
  }
  return all;
}

}  // namespace spikeserve
