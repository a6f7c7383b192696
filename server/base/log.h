// The server's log: one line an event on standard error, as text or as JSON.
//
//   LogWarning("policy refused", {{"path", path}, {"error", status.message()}});
//
// writes, as text and as JSON:
//
//   2027-01-31T12:00:00.000Z warning policy refused path="a/1/policy.safetensors" error="..."
//   {"time":"2027-01-31T12:00:00.000Z","level":"warning","message":"policy refused","path":"a/...
//
// Values may come from the wire: control characters and bytes that are not UTF-8 are escaped, so
// that no value can forge a line or reach a terminal. Thread-safe.
#ifndef SERVER_BASE_LOG_H_
#define SERVER_BASE_LOG_H_

#include <array>
#include <initializer_list>

#include "absl/strings/string_view.h"
#include "core/base/enum_names.h"

namespace spikeserve {

enum class LogFormat { kText, kJson };

constexpr std::array<EnumName<LogFormat>, 2> EnumNames(LogFormat) {
  return {{{LogFormat::kText, "text"}, {LogFormat::kJson, "json"}}};
}

struct LogField {
  absl::string_view key;  // a constant of the program: letters, digits and underscores
  absl::string_view value;
};

// Sets the format of every line from now on; text until then.
void SetLogFormat(LogFormat format);

// Write one line each. `message` is a constant of the program; what varies belongs into fields.
void LogInfo(absl::string_view message, std::initializer_list<LogField> fields = {});
void LogWarning(absl::string_view message, std::initializer_list<LogField> fields = {});
void LogError(absl::string_view message, std::initializer_list<LogField> fields = {});

}  // namespace spikeserve

#endif  // SERVER_BASE_LOG_H_
