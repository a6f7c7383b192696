#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "absl/strings/str_replace.h"
#include "absl/strings/substitute.h"
#include "core/cli/program_parts.h"

namespace spikeserve {
namespace {

std::string ShellQuoted(absl::string_view text) {
  return absl::StrCat("'", absl::StrReplaceAll(text, {{"'", "'\\''"}}), "'");
}

// Returns the name of the shell function that completes `command`.
std::string FunctionName(const CommandInfo& command) {
  return absl::StrCat("_", absl::StrJoin(command.path, "_"));
}

// --- bash

// Returns the subcommands and flags of `command`, separated by spaces. A flag that takes a value
// ends with "=".
std::string BashWords(const CommandInfo& program, const CommandInfo& command) {
  std::vector<std::string> words;
  for (const CommandInfo& subcommand : command.commands) words.push_back(subcommand.name());
  for (const FlagInfo& flag : AcceptedFlags(program, command)) {
    words.push_back(absl::StrCat("--", flag.name, flag.is_switch() ? "" : "="));
  }
  return absl::StrJoin(words, " ");
}

// Returns the bash commands that complete a value of `flag`, or an empty string if its values
// cannot be completed.
std::string BashValues(const FlagInfo& flag) {
  const bool is_directory = flag.kind == "DIR";
  if (is_directory || flag.kind == "FILE") {
    // With `-o filenames` bash quotes the words, which would change the "=" of a prefix "--flag=".
    return absl::StrCat(
        "[[ -n $prefix ]] || compopt -o filenames; mapfile -t COMPREPLY < <(compgen ",
        is_directory ? "-d" : "-f", " -- \"$current\")");
  }
  const std::string choices = absl::StrJoin(flag.choices(), " ");
  if (choices.empty()) return "";
  return absl::StrCat("mapfile -t COMPREPLY < <(compgen -W ", ShellQuoted(choices),
                      " -- \"$current\")");
}

constexpr char kBashScript[] = R"(# bash completion of $0, as "$0 --generate=bash" prints it.
$1() {
  local current="$${COMP_WORDS[COMP_CWORD]}" previous="$${COMP_WORDS[COMP_CWORD - 1]}"
  local command='' flag='' prefix='' words='' word
  for word in "$${COMP_WORDS[@]:1:COMP_CWORD-1}"; do
    case "$${command:+$$command }$$word" in
$2    esac
  done
  case "$$command" in
$3  esac
  # "=" is a word of its own unless COMP_WORDBREAKS lacks it.
  if [[ $$current == --*=* ]]; then
    flag=$${current%%=*} prefix=$$flag= current=$${current#*=}
  elif [[ $$current == = ]]; then
    flag=$$previous current=''
  elif [[ $$previous == = ]]; then
    flag=$${COMP_WORDS[COMP_CWORD - 2]}
  elif [[ " $$words " == *" $$previous= "* ]]; then
    flag=$$previous
  fi
  if [[ -z $$flag ]]; then
    mapfile -t COMPREPLY < <(compgen -W "$$words" -- "$$current")
    [[ $${#COMPREPLY[@]} -ne 1 || $${COMPREPLY[0]} != *= ]] || compopt -o nospace
    return 0
  fi
  case "$$command $$flag" in
$4    *) COMPREPLY=(); return 0 ;;
  esac
  COMPREPLY=("$${COMPREPLY[@]/#/$$prefix}")
}
complete -F $1 $0
)";

// --- zsh

// Escapes `text` for an argument specification of zsh's _arguments.
std::string ZshText(absl::string_view text) {
  return absl::StrReplaceAll(text, {{"\\", "\\\\"}, {"[", "\\["}, {"]", "\\]"}, {":", "\\:"}});
}

std::string ZshFlag(const FlagInfo& flag) {
  const std::string help = absl::StrCat("[", ZshText(flag.help), "]");
  if (flag.is_switch()) return ShellQuoted(absl::StrCat("--", flag.name, help));
  std::string values = " ";
  if (flag.kind == "FILE") values = "_files";
  if (flag.kind == "DIR") values = "_files -/";
  if (!flag.choices().empty()) values = absl::StrCat("(", absl::StrJoin(flag.choices(), " "), ")");
  return ShellQuoted(
      absl::StrCat("--", flag.name, "=", help, ":", ZshText(flag.kind), ":", values));
}

// Returns the shell function that completes the words after `command`.
std::string ZshFunction(const CommandInfo& program, const CommandInfo& command) {
  std::string text = absl::StrCat(FunctionName(command), "() {\n  local curcontext=$curcontext ",
                                  "state line\n  _arguments -C");
  for (const FlagInfo& flag : AcceptedFlags(program, command)) {
    absl::StrAppend(&text, " \\\n    ", ZshFlag(flag));
  }
  if (command.commands.empty()) return absl::StrCat(text, "\n}\n");
  absl::StrAppend(&text, " \\\n    '1: :->command' '*:: :->rest'\n  local -a commands=(\n");
  for (const CommandInfo& subcommand : command.commands) {
    absl::StrAppend(&text, "    ",
                    ShellQuoted(absl::StrCat(subcommand.name(), ":", subcommand.summary)), "\n");
  }
  return absl::StrCat(text, "  )\n  case $state in\n    command) _describe command commands ;;\n",
                      "    rest) (( $+functions[", FunctionName(command), "_$line[1]] )) && ",
                      FunctionName(command), "_$line[1] ;;\n  esac\n}\n");
}

// --- fish

// Returns a fish condition that is true if the command line selects `command` and none of its
// subcommands.
std::string FishCondition(const CommandInfo& command) {
  std::vector<std::string> conditions;
  for (size_t i = 1; i < command.path.size(); ++i) {
    conditions.push_back("__fish_seen_subcommand_from " + command.path[i]);
  }
  if (!command.commands.empty()) {
    const std::string names = absl::StrJoin(
        command.commands, " ",
        [](std::string* out, const CommandInfo& below) { out->append(below.name()); });
    conditions.push_back("not __fish_seen_subcommand_from " + names);
  }
  return absl::StrJoin(conditions, "; and ");
}

std::string FishFlag(const FlagInfo& flag) {
  const char* values = " -x";  // requires a value that is not a file
  if (flag.is_switch()) values = "";
  if (flag.kind == "FILE") values = " -r -F";
  std::string line = absl::StrCat(" -l ", flag.name, values);
  if (flag.kind == "DIR") absl::StrAppend(&line, " -a '(__fish_complete_directories)'");
  const std::vector<std::string> choices = flag.choices();
  if (!choices.empty()) absl::StrAppend(&line, " -a ", ShellQuoted(absl::StrJoin(choices, " ")));
  return absl::StrCat(line, " -d ", ShellQuoted(flag.help), "\n");
}

}  // namespace

std::string BashCompletion(const CommandInfo& program) {
  std::string paths, words, values;
  for (const CommandInfo* command : AllCommands(program)) {
    const std::string path = command->SubPath(" ");
    if (command != &program) {
      absl::StrAppend(&paths, "      ", ShellQuoted(path), ") command=", ShellQuoted(path),
                      " ;;\n");
    }
    absl::StrAppend(&words, "    ", ShellQuoted(path),
                    ") words=", ShellQuoted(BashWords(program, *command)), " ;;\n");
    for (const FlagInfo& flag : AcceptedFlags(program, *command)) {
      const std::string complete = BashValues(flag);
      if (complete.empty()) continue;
      absl::StrAppend(&values, "    ", ShellQuoted(absl::StrCat(path, " --", flag.name)), ") ",
                      complete, " ;;\n");
    }
  }
  return absl::Substitute(kBashScript, program.name(), FunctionName(program), paths, words, values);
}

std::string ZshCompletion(const CommandInfo& program) {
  std::string text =
      absl::StrCat("#compdef ", program.name(), "\n# zsh completion of ", program.name(), ", as \"",
                   program.name(), " --generate=zsh\" prints it.\n");
  for (const CommandInfo* command : AllCommands(program)) {
    absl::StrAppend(&text, ZshFunction(program, *command));
  }
  return absl::StrCat(text, FunctionName(program), " \"$@\"\n");
}

std::string FishCompletion(const CommandInfo& program) {
  const std::string complete = absl::StrCat("complete -c ", program.name());
  std::string text =
      absl::StrCat("# fish completion of ", program.name(), ", as \"", program.name(),
                   " --generate=fish\" prints it.\n", complete, " -f\n");
  for (const FlagInfo& flag : program.flags) absl::StrAppend(&text, complete, FishFlag(flag));
  for (const CommandInfo* command : AllCommands(program)) {
    const std::string condition = FishCondition(*command);
    const std::string start =
        condition.empty() ? complete : absl::StrCat(complete, " -n ", ShellQuoted(condition));
    for (const CommandInfo& subcommand : command->commands) {
      absl::StrAppend(&text, start, " -a ", subcommand.name(), " -d ",
                      ShellQuoted(subcommand.summary), "\n");
    }
    if (command == &program) continue;
    for (const FlagInfo& flag : command->flags) absl::StrAppend(&text, start, FishFlag(flag));
  }
  return text;
}

}  // namespace spikeserve
