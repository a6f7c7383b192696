#include <cstdlib>
#include <string>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "core/cli/program_parts.h"

namespace spikeserve {
namespace {

CLI::App* FindCommand(CLI::App* app, const std::string& name) {
  const auto found =
      app->get_subcommands([&](CLI::App* command) { return command->get_name() == name; });
  return found.empty() ? nullptr : found.front();
}

// CLI11 marks the beginning and the end of a section with items of these names.
bool IsMark(const CLI::ConfigItem& item) { return item.name == "++" || item.name == "--"; }

CLI::App* CommandOf(const CLI::ConfigItem& item, CLI::App* app) {
  for (const std::string& name : item.parents) {
    app = FindCommand(app, name);
    if (app == nullptr) {
      throw CLI::ConfigError(absl::StrCat("expected sections named as commands, received [",
                                          absl::StrJoin(item.parents, "."), "]"));
    }
  }
  return app;
}

// Returns whether the environment sets the flag of `item`. Throws CLI::ConfigError if `item` is
// invalid.
bool CheckAndFindInEnvironment(const CLI::ConfigItem& item, CLI::App* app) {
  const CLI::Option* const option = app->get_option_no_throw("--" + item.name);
  if (option == nullptr || !option->get_configurable()) {
    throw CLI::ConfigError(absl::StrCat("expected flags of ", app->get_display_name(),
                                        ", received \"", item.name, "\""));
  }
  const bool is_list = option->get_multi_option_policy() == CLI::MultiOptionPolicy::TakeAll;
  if (item.inputs.size() != 1 && !is_list) {
    throw CLI::ConfigError(absl::StrCat("--", item.name, ": expected one value, received \"",
                                        absl::StrJoin(item.inputs, ","), "\""));
  }
  return std::getenv(option->get_envname().c_str()) != nullptr;
}

}  // namespace

std::vector<CLI::ConfigItem> ConfigFile::from_config(std::istream& input) const {
  std::vector<CLI::ConfigItem> kept;
  for (CLI::ConfigItem& item : ConfigBase::from_config(input)) {
    CLI::App* const command = CommandOf(item, root_);
    if (IsMark(item) || CheckAndFindInEnvironment(item, command)) continue;
    kept.push_back(std::move(item));
  }
  return kept;
}

}  // namespace spikeserve
