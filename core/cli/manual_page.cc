#include <cstdlib>
#include <vector>

#include "absl/algorithm/container.h"
#include "absl/strings/ascii.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "absl/strings/str_replace.h"
#include "absl/strings/substitute.h"
#include "absl/time/clock.h"
#include "absl/time/time.h"
#include "core/base/version.h"
#include "core/cli/program_parts.h"

namespace spikeserve {
namespace {

// Escapes `text` so that roff prints it unchanged: without commands, and with ASCII dashes.
std::string Escaped(absl::string_view text) {
  std::string escaped = absl::StrReplaceAll(text, {{"\\", "\\e"}, {"-", "\\-"}});
  if (!escaped.empty() && (escaped[0] == '.' || escaped[0] == '\'')) escaped.insert(0, "\\&");
  return escaped;
}

std::string Date() {
  absl::Time date = absl::Now();
  int64_t seconds = 0;
  const char* const epoch = std::getenv("SOURCE_DATE_EPOCH");
  if (epoch != nullptr && absl::SimpleAtoi(epoch, &seconds)) date = absl::FromUnixSeconds(seconds);
  return absl::FormatTime("%Y-%m-%d", date, absl::UTCTimeZone());
}

std::string Flag(const FlagInfo& flag) {
  const std::string value =
      flag.is_switch() ? "" : absl::StrCat("=\\fI", Escaped(flag.kind), "\\fR");
  const std::string default_text =
      flag.default_text.empty() ? "" : absl::StrCat("Default: ", Escaped(flag.default_text), ".\n");
  return absl::StrCat(".TP\n\\fB\\-\\-", Escaped(flag.name), "\\fR", value, "\n",
                      Escaped(flag.help), ".\n", default_text);
}

// Returns the flags grouped by heading, the flags of every program last. `before` and `after` are
// the texts around a heading.
std::string Flags(const CommandInfo& command, const char* before, const char* after) {
  std::vector<std::string> headings;
  for (const FlagInfo& flag : command.flags) {
    if (!absl::c_linear_search(headings, flag.heading)) headings.push_back(flag.heading);
  }
  absl::c_stable_partition(headings,
                           [](const std::string& heading) { return heading != kGeneralHeading; });
  std::string text;
  for (const std::string& heading : headings) {
    absl::StrAppend(&text, before, Escaped(heading), after);
    for (const FlagInfo& flag : command.flags) {
      if (flag.heading == heading) text += Flag(flag);
    }
  }
  return text;
}

std::string Commands(const CommandInfo& program) {
  std::string text;
  for (const CommandInfo* command : AllCommands(program)) {
    if (command == &program) continue;
    absl::StrAppend(&text, ".SS ", Escaped(absl::StrJoin(command->path, " ")), "\n",
                    Escaped(command->summary), ".\n", Flags(*command, ".PP\n", ":\n"));
  }
  return text.empty() ? "" : absl::StrCat(".SH COMMANDS\n", text);
}

constexpr char kPage[] = R"(.TH $0 1 $1 "spikeserve $2"
.SH NAME
$3 \- $4
.SH SYNOPSIS
.B $3
$5[\fB\-\-\fIflag\fR=\fIvalue\fR ...]
.SH DESCRIPTION
$4.
$6.SH OPTIONS
$7.SH ENVIRONMENT
A flag that is not on the command line is taken from the variable
$0_\fIFLAG\fR, the name of the program and of the flag in capitals.
A variable that is empty sets the empty value.
.SH FILES
A flag that is neither on the command line nor in the environment is taken
from the file of
.BR \-\-config ,
TOML or INI, as a line \fIflag\fR = \fIvalue\fR.
The flags of a command are in a section [\fIcommand\fR].
.SH EXIT STATUS
0 on success, 1 on an error, of which one line on standard error tells.
)";

}  // namespace

std::string ManualPage(const CommandInfo& program) {
  const char* const command = program.commands.empty() ? "" : "\\fIcommand\\fR ";
  return absl::Substitute(kPage, absl::AsciiStrToUpper(program.name()), Date(),
                          std::string(Version()), program.name(), Escaped(program.summary), command,
                          Commands(program), Flags(program, ".SS ", "\n"));
}

}  // namespace spikeserve
