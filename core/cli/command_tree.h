// Describes the commands and flags of a program as plain data. The completion scripts and the
// manual page are generated from it.
//
// Immutable once built; safe to read from many threads.
#pragma once

#include <string>
#include <vector>

namespace CLI {
class App;
}

namespace spikeserve {

// The heading of the flags that every program has. It is the last heading of a help text.
inline constexpr char kGeneralHeading[] = "General";

// The help text only counts the flags under a heading that begins with this; the manual describes
// them. For flags that few users change.
inline constexpr char kAdvancedPrefix[] = "Advanced: ";

struct FlagInfo {
  std::string name;          // without dashes
  std::string heading;       // the heading of its group
  std::string kind;          // the kind of its value, see flag_group.h; empty for a switch
  std::string default_text;  // empty if there is no default
  std::string help;

  bool is_switch() const { return kind.empty(); }
  // Returns the words of a kind such as unary|stream|batch. Returns none for any other kind.
  std::vector<std::string> choices() const;
};

struct CommandInfo {
  std::vector<std::string> path;  // the name of the program, then the names of the commands
  std::string summary;
  std::vector<FlagInfo> flags;  // without the flags of the program
  std::vector<CommandInfo> commands;

  const std::string& name() const { return path.back(); }
  // Returns the names of `path` after the program's name, separated by `separator`.
  std::string SubPath(const std::string& separator) const;
};

// Describes `app` and all of its subcommands.
CommandInfo DescribeCommands(const CLI::App& app);

// Returns the flags that `command` accepts: its own flags, and those flags of `program` that it
// does not replace by a flag of the same name.
std::vector<FlagInfo> AcceptedFlags(const CommandInfo& program, const CommandInfo& command);

// Returns `command` and all of its subcommands, parents first. The pointers point into `command`.
std::vector<const CommandInfo*> AllCommands(const CommandInfo& command);

}  // namespace spikeserve
