#include <algorithm>
#include <cstdlib>
#include <string>
#include <vector>

#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "core/cli/program_parts.h"

namespace spikeserve {
namespace {

std::string PathOf(const CLI::App& app) {
  const CLI::App* const parent = app.get_parent();
  return parent == nullptr ? app.get_name() : absl::StrCat(PathOf(*parent), " ", app.get_name());
}

const CLI::Option* FindBelow(const std::string& name, const CLI::App& app) {
  if (const CLI::Option* const option = app.get_option_no_throw(name)) return option;
  for (const CLI::App* command : app.get_subcommands({})) {
    if (const CLI::Option* const option = FindBelow(name, *command)) return option;
  }
  return nullptr;
}

// Returns the flag whose name the message begins with, or null if there is none. Prefers flags of
// the selected command; an invalid value of a variable or a file may belong to another command.
const CLI::Option* FlagOf(absl::string_view message, const CLI::App& root) {
  const std::string name(message.substr(0, message.find_first_of(":= ")));
  for (const CLI::App* app = &SelectedCommand(root); app != nullptr; app = app->get_parent()) {
    if (const CLI::Option* const option = app->get_option_no_throw(name)) return option;
  }
  return FindBelow(name, root);
}

bool IsOnCommandLine(const CLI::Option* option, const CLI::App* app) {
  for (; app != nullptr; app = app->get_parent()) {
    const std::vector<CLI::Option*>& given = app->parse_order();
    if (std::find(given.begin(), given.end(), option) != given.end()) return true;
  }
  return false;
}

std::string ConfigPath(const CLI::App& root) {
  const std::vector<std::string> paths = root.get_config_ptr()->results();
  return paths.empty() ? "" : paths.back();
}

// Returns the variable or the file that an invalid value came from, followed by a colon, or an
// empty string if it came from the command line.
std::string Source(const CLI::App& root, absl::string_view message) {
  const CLI::Option* const option = FlagOf(message, root);
  if (option == nullptr || IsOnCommandLine(option, &SelectedCommand(root))) return "";
  const bool is_in_environment = std::getenv(option->get_envname().c_str()) != nullptr;
  if (is_in_environment) return option->get_envname() + ": ";
  return ConfigPath(root) + ": ";
}

// Returns the error message for `argument`, which is neither a subcommand nor a flag of `command`.
std::string Unexpected(const CLI::App& command, const std::string& argument) {
  if (absl::StartsWith(argument, "-")) {
    return absl::StrCat(argument.substr(0, argument.find('=')), ": expected a flag of ",
                        PathOf(command), " (see ", PathOf(command), " --help), received ",
                        argument);
  }
  const std::vector<const CLI::App*> commands = command.get_subcommands(
      [](const CLI::App* subcommand) { return !subcommand->get_group().empty(); });
  if (commands.empty()) {
    const std::string place =
        command.get_parent() == nullptr ? "" : absl::StrCat(command.get_name(), ": ");
    return absl::StrCat(place, "expected flags alone, received \"", argument, "\"");
  }
  const std::string names = absl::StrJoin(
      commands, ", ",
      [](std::string* out, const CLI::App* subcommand) { out->append(subcommand->get_name()); });
  return absl::StrCat(command.get_parent() == nullptr ? "command" : command.get_name(),
                      ": expected one of ", names, ", received ",
                      argument.empty() ? "none" : absl::StrCat("\"", argument, "\""));
}

std::string Message(const CLI::App& root, const CLI::ParseError& error) {
  const std::string text = error.what();
  switch (static_cast<CLI::ExitCodes>(error.get_exit_code())) {
    case CLI::ExitCodes::ExtrasError:
    case CLI::ExitCodes::RequiredError: {
      const std::vector<std::string> remaining = root.remaining(/*recurse=*/true);
      return Unexpected(SelectedCommand(root), remaining.empty() ? "" : remaining.front());
    }
    case CLI::ExitCodes::ArgumentMismatch: {
      const CLI::Option* const option = FlagOf(text, root);
      if (option == nullptr) return text;
      return absl::StrCat(option->get_name(), ": expected ", option->get_type_name(),
                          ", received none");
    }
    case CLI::ExitCodes::FileError:
      return absl::StrCat("--config: expected a file that can be read, received \"",
                          ConfigPath(root), "\"");
    case CLI::ExitCodes::ConfigError:
      return absl::StrCat(ConfigPath(root), ": ", text);
    default:
      return absl::StrCat(Source(root, text), text);
  }
}

}  // namespace

const CLI::App& SelectedCommand(const CLI::App& root) {
  const CLI::App* command = &root;
  while (!command->get_subcommands().empty()) command = command->get_subcommands().back();
  return *command;
}

absl::Status StatusFromParseError(const CLI::App& root, const CLI::ParseError& error) {
  return absl::InvalidArgumentError(Message(root, error));
}

}  // namespace spikeserve
