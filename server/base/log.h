// Logs one line per event to standard error, as text or as JSON.
//
//   LogWarning("policy refused", {{"path", path}, {"error", status.message()}});
//
// writes as text, or as JSON:
//
//   2027-01-31T12:00:00.000Z warning policy refused path="a/1/policy.safetensors" error="..."
//   {"time":"2027-01-31T12:00:00.000Z","level":"warning","message":"policy refused","path":"a/...
//
// Escapes control characters and invalid UTF-8 in values, because values may come from clients: a
// value can neither forge a log line nor send control sequences to a terminal.
//
// Writes at most kMostLinesPerSecond lines of a kind a second, so that events that clients cause
// cannot fill a disk. Lines of the same level and message are of one kind. The next line of the
// kind says in the field `suppressed` how many were left out. Thread-safe.
#pragma once

#include <array>
#include <initializer_list>

#include "absl/strings/string_view.h"
#include "core/base/enum_names.h"

namespace spikeserve {

inline constexpr int kMostLinesPerSecond = 10;

enum class LogFormat { kText, kJson };

constexpr std::array<EnumName<LogFormat>, 2> EnumNames(LogFormat) {
  return {{{LogFormat::kText, "text"}, {LogFormat::kJson, "json"}}};
}

struct LogField {
  absl::string_view key;  // a constant of the program: letters, digits and underscores
  absl::string_view value;
};

// Sets the format of all later lines. The default is text.
void SetLogFormat(LogFormat format);

// Write one line. `message` is a constant of the program; values that vary belong into `fields`.
void LogInfo(absl::string_view message, std::initializer_list<LogField> fields = {});
void LogWarning(absl::string_view message, std::initializer_list<LogField> fields = {});
void LogError(absl::string_view message, std::initializer_list<LogField> fields = {});

}  // namespace spikeserve
