#include "server/base/log.h"

#include <spdlog/sinks/stdout_sinks.h>
#include <spdlog/spdlog.h>

#include <atomic>
#include <memory>
#include <string>

#include "absl/strings/str_cat.h"
#include "nlohmann/json.hpp"

namespace spikeserve {
namespace {

constexpr char kTextPattern[] = "%Y-%m-%dT%H:%M:%S.%eZ %l %v";
constexpr char kJsonPattern[] = R"({"time":"%Y-%m-%dT%H:%M:%S.%eZ","level":"%l",%v})";

std::atomic<LogFormat> format = LogFormat::kText;

void SetPattern(spdlog::logger& logger, LogFormat wanted) {
  logger.set_pattern(wanted == LogFormat::kJson ? kJsonPattern : kTextPattern,
                     spdlog::pattern_time_type::utc);
}

// Returns the logger, which is never destroyed, so that threads may log while the program exits.
spdlog::logger& Logger() {
  static spdlog::logger* const logger = [] {
    auto* made = std::make_unique<spdlog::logger>("spikeserve",
                                                  std::make_shared<spdlog::sinks::stderr_sink_mt>())
                     .release();
    SetPattern(*made, LogFormat::kText);
    made->flush_on(spdlog::level::info);
    return made;
  }();
  return *logger;
}

// Returns `text` as a JSON string of printable ASCII. Escapes all other bytes.
std::string Escaped(absl::string_view text) {
  return nlohmann::json(std::string(text))
      .dump(/*indent=*/-1, /*indent_char=*/' ', /*ensure_ascii=*/true,
            nlohmann::json::error_handler_t::replace);
}

void Write(spdlog::level::level_enum level, absl::string_view message,
           std::initializer_list<LogField> fields) {
  const bool json = format.load(std::memory_order_relaxed) == LogFormat::kJson;
  std::string line = json ? absl::StrCat("\"message\":", Escaped(message)) : std::string(message);
  for (const LogField& field : fields) {
    if (json) {
      absl::StrAppend(&line, ",\"", field.key, "\":", Escaped(field.value));
    } else {
      absl::StrAppend(&line, " ", field.key, "=", Escaped(field.value));
    }
  }
  Logger().log(level, spdlog::string_view_t(line));
}

}  // namespace

void SetLogFormat(LogFormat wanted) {
  SetPattern(Logger(), wanted);
  format = wanted;
}

void LogInfo(absl::string_view message, std::initializer_list<LogField> fields) {
  Write(spdlog::level::info, message, fields);
}

void LogWarning(absl::string_view message, std::initializer_list<LogField> fields) {
  Write(spdlog::level::warn, message, fields);
}

void LogError(absl::string_view message, std::initializer_list<LogField> fields) {
  Write(spdlog::level::err, message, fields);
}

}  // namespace spikeserve
