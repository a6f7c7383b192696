// The commands and flags of a program as plain data, from which its help texts are generated.
//
// Immutable once built; safe to read from many threads.
#ifndef CORE_CLI_COMMAND_TREE_H_
#define CORE_CLI_COMMAND_TREE_H_

#include <string>
#include <vector>

namespace CLI {
class App;
}

namespace spikeserve {

// The heading of the flags that every program has; they stand last.
inline constexpr char kGeneralHeading[] = "General";

struct FlagInfo {
  std::string name;          // without dashes
  std::string heading;       // of its group
  std::string kind;          // of its value, see flag_group.h; empty for a switch
  std::string default_text;  // empty where there is none
  std::string help;

  bool is_switch() const { return kind.empty(); }
  // The words of a kind such as unary|stream|batch; else empty.
  std::vector<std::string> choices() const;
};

struct CommandInfo {
  std::vector<std::string> path;  // from the program's name on
  std::string summary;
  std::vector<FlagInfo> flags;  // its own
  std::vector<CommandInfo> commands;

  const std::string& name() const { return path.back(); }
  // The path below the program, separated by `separator`.
  std::string SubPath(const std::string& separator) const;
};

// Describes `app` and everything below it.
CommandInfo DescribeCommands(const CLI::App& app);

// Returns the flags that `command` accepts: its own, and those of `program` that have other names.
std::vector<FlagInfo> AcceptedFlags(const CommandInfo& program, const CommandInfo& command);

// Returns `command` and everything below it, parents first. The pointers are into `command`.
std::vector<const CommandInfo*> AllCommands(const CommandInfo& command);

}  // namespace spikeserve

#endif  // CORE_CLI_COMMAND_TREE_H_
