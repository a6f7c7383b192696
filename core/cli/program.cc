#include "core/cli/program.h"

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cstdlib>
#include <iostream>
#include <utility>
#include <vector>

#include "absl/strings/ascii.h"
#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/base/version.h"
#include "core/cli/command_tree.h"
#include "core/cli/program_parts.h"

namespace spikeserve {
namespace {

// Flags of the group `heading` have no effect together with `flag`.
struct Refusal {
  const CLI::App* command;
  std::string flag;
  std::string heading;
};

// Thrown by --generate to end the parsing, as CLI11 throws CallForHelp for --help.
class CallForGeneration final : public CLI::Success {
 public:
  explicit CallForGeneration(std::string kind)
      : Success("CallForGeneration", std::move(kind), CLI::ExitCodes::Success) {}
};

std::string VariableOf(const CLI::App& root, const CLI::Option& option) {
  return absl::AsciiStrToUpper(absl::StrCat(root.get_name(), "_", option.get_lnames().front()));
}

// Sets the environment variables of all flags. Hides the --help flags of subcommands, because their
// help lists --help among the flags of the program.
void CompleteFlags(const CLI::App& root, CLI::App* app) {
  for (CLI::Option* option : app->get_options({})) {
    if (option->get_configurable()) option->envname(VariableOf(root, *option));
  }
  for (CLI::App* command : app->get_subcommands({})) {
    command->get_option("--help")->group("");
    CompleteFlags(root, command);
  }
}

// Sets the flags of `app` and its subcommands whose variable is set but empty to the empty value,
// unless the command line sets them. CLI11 ignores such variables.
void ReadEmptyVariables(CLI::App* app) {
  for (CLI::Option* option : app->get_options({})) {
    const char* const variable = std::getenv(option->get_envname().c_str());
    if (variable == nullptr || *variable != '\0' || option->count() > 0) continue;
    option->add_result("");
    option->run_callback();
  }
  for (CLI::App* command : app->get_subcommands({})) ReadEmptyVariables(command);
}

// Returns the arguments in reverse order, as CLI11 expects them.
std::vector<std::string> Arguments(const CLI::App& root, int argc, const char* const* argv) {
  std::vector<std::string> arguments;
  // CLI11 reads the file before the environment.
  const char* const config = std::getenv(VariableOf(root, *root.get_config_ptr()).c_str());
  if (config != nullptr && *config != '\0') arguments.push_back(absl::StrCat("--config=", config));
  for (int i = 1; i < argc; ++i) {
    const std::string argument = argv[i];
    // CLI11 would use the argument after "--name=" as the value.
    const bool is_empty_value = absl::StartsWith(argument, "--") && argument.back() == '=' &&
                                argument.find('=') + 1 == argument.size();
    if (!is_empty_value) {
      arguments.push_back(argument);
    } else {
      arguments.push_back(argument.substr(0, argument.size() - 1));
      arguments.push_back("");
    }
  }
  std::reverse(arguments.begin(), arguments.end());
  return arguments;
}

std::string Generate(const CLI::App& root, const std::string& kind) {
  const CommandInfo program = DescribeCommands(root);
  if (kind == "bash") return BashCompletion(program);
  if (kind == "zsh") return ZshCompletion(program);
  if (kind == "fish") return FishCompletion(program);
  return ManualPage(program);
}

absl::Status CallGenerator(const std::string& kind) {
  for (const char* known : {"bash", "zsh", "fish", "man"}) {
    if (kind == known) throw CallForGeneration(kind);
  }
  return absl::InvalidArgumentError(
      absl::StrCat("expected bash, zsh, fish or man, received \"", kind, "\""));
}

// Appends the flags of `app` that are set.
void AppendFlags(const CLI::App& app, std::string* line) {
  for (const CLI::Option* option : app.get_options({})) {
    if (option->count() == 0 || !option->get_configurable()) continue;
    const std::string value = absl::StrJoin(option->reduced_results(), ",");
    const bool is_set_switch = option->get_expected_max() == 0 && value == "true";
    absl::StrAppend(line, " ", option->get_name(), is_set_switch ? "" : "=",
                    is_set_switch ? "" : value);
  }
}

}  // namespace

struct ProgramState {
  ProgramState(const std::string& name, const std::string& summary, ErrorCodes codes)
      : app(summary, name), error_codes(codes) {}

  CLI::App app;
  const ErrorCodes error_codes;
  std::function<absl::Status()> action;  // of the selected command
  std::vector<Refusal> refusals;
  std::vector<std::string> other_variables;
};

Command Command::AddCommand(const std::string& name, const std::string& summary) const {
  app_->require_subcommand(1);
  return Command(app_->add_subcommand(name, summary)->group("Commands"), state_);
}

void Command::SetAction(std::function<absl::Status()> action) const {
  app_->callback([state = state_, action = std::move(action)] { state->action = action; });
}

void Command::Hide() const { app_->group(""); }

void Command::RefuseBeside(const std::string& flag, const std::string& heading) const {
  state_->refusals.push_back({app_, "--" + flag, heading});
}

Program::Program(const std::string& name, const std::string& summary, ErrorCodes error_codes)
    : state_(std::make_unique<ProgramState>(name, summary, error_codes)) {
  CLI::App& app = state_->app;
  app.formatter(std::make_shared<HelpFormat>());
  app.fallthrough();
  app.footer(absl::StrCat("A flag can also be set by the environment variable ",
                          absl::AsciiStrToUpper(name),
                          "_<FLAG>,\nor as `flag = value` in the file of --config."));
  app.set_help_flag("-h,--help", "Print this help")->group(kGeneralHeading);
  app.set_version_flag("--version", absl::StrCat(name, " ", Version()), "Print the version")
      ->group(kGeneralHeading);
  app.config_formatter(std::make_shared<ConfigFile>(&app));
  app.set_config("--config", "", "TOML or INI file of flags")
      ->type_name("FILE")
      ->group(kGeneralHeading)
      ->take_last();
  root()
      .Flags(kGeneralHeading)
      .AddParsed("generate", "bash|zsh|fish|man", "", CallGenerator,
                 "Print a completion script or the manual");
  app.get_option("--generate")->configurable(false);
}

Program::~Program() = default;

void Program::AllowVariable(const std::string& name) { state_->other_variables.push_back(name); }

Command Program::root() { return Command(&state_->app, state_.get()); }

absl::StatusOr<std::string> Program::Parse(int argc, const char* const* argv) {
  CLI::App& app = state_->app;
  CompleteFlags(app, &app);
  try {
    app.parse(Arguments(app, argc, argv));
    ReadEmptyVariables(&app);
  } catch (const CLI::CallForHelp&) {
    return app.help();
  } catch (const CLI::CallForVersion& version) {
    return absl::StrCat(version.what(), "\n");
  } catch (const CallForGeneration& generation) {
    return Generate(app, generation.what());
  } catch (const CLI::ParseError& error) {
    return StatusFromParseError(app, error);
  }
  if (absl::Status status = CheckVariables(app, state_->other_variables); !status.ok()) {
    return status;
  }
  RETURN_IF_ERROR(CheckRefusals());
  return std::string();
}

absl::Status Program::CheckRefusals() const {
  for (const Refusal& refusal : state_->refusals) {
    if (refusal.command->get_option(refusal.flag)->count() == 0) continue;
    for (const CLI::Option* option : refusal.command->parse_order()) {
      if (option->get_group() != refusal.heading) continue;
      return InvalidArgument(option->get_name(), absl::StrCat("no such flag beside ", refusal.flag),
                             absl::StrJoin(option->results(), ","));
    }
  }
  return absl::OkStatus();
}

int Program::Run(int argc, const char* const* argv) {
  const absl::StatusOr<std::string> answer = Parse(argc, argv);
  if (answer.ok() && !answer->empty()) {
    std::cout << *answer << std::flush;
    return 0;
  }
  const absl::Status status = answer.ok() ? state_->action() : answer.status();
  if (status.ok()) return 0;
  std::cerr << state_->app.get_name() << ": " << status.message();
  if (state_->error_codes == ErrorCodes::kShown) {
    std::cerr << " (" << absl::StatusCodeToString(status.code()) << ")";
  }
  std::cerr << std::endl;
  return 1;
}

std::string Program::CommandLine() const {
  const CLI::App* command = &state_->app;
  std::string line = command->get_name();
  AppendFlags(*command, &line);
  while (!command->get_subcommands().empty()) {
    command = command->get_subcommands().back();
    absl::StrAppend(&line, " ", command->get_name());
    AppendFlags(*command, &line);
  }
  return line;
}

}  // namespace spikeserve
