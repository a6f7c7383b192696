#include "server/base/log.h"

#include <spdlog/sinks/stdout_sinks.h>
#include <spdlog/spdlog.h>

#include <atomic>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/clock.h"
#include "absl/time/time.h"
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

// Counts the lines of one kind.
class LineBudget {
 public:
  // Returns how many lines were left out since the last one, or nothing if this one is to be left
  // out, too.
  std::optional<int64_t> Take(absl::Time now) {
    if (now - second_ >= absl::Seconds(1) || now < second_) {
      second_ = now;
      lines_ = 0;
    }
    if (++lines_ > kMostLinesPerSecond) {
      ++suppressed_;
      return std::nullopt;
    }
    return std::exchange(suppressed_, 0);
  }

 private:
  absl::Time second_ = absl::InfinitePast();  // start of the running second
  int64_t lines_ = 0;                         // in it
  int64_t suppressed_ = 0;
};

// Returns the result of LineBudget::Take() for a line of this kind. There are as many kinds as
// constants in the program.
std::optional<int64_t> TakeLine(spdlog::level::level_enum level, absl::string_view message) {
  using Kind = std::pair<int, std::string>;
  static absl::Mutex mutex(absl::kConstInit);
  static auto* const budgets = new std::map<Kind, LineBudget>();  // never destroyed, as Logger()
  absl::MutexLock lock(&mutex);
  return (*budgets)[Kind(level, message)].Take(absl::Now());
}

void AppendField(bool json, absl::string_view key, absl::string_view value, std::string* line) {
  if (json) {
    absl::StrAppend(line, ",\"", key, "\":", Escaped(value));
  } else {
    absl::StrAppend(line, " ", key, "=", Escaped(value));
  }
}

void Write(spdlog::level::level_enum level, absl::string_view message,
           std::initializer_list<LogField> fields) {
  const auto suppressed = TakeLine(level, message);
  if (!suppressed.has_value()) return;
  const bool json = format.load(std::memory_order_relaxed) == LogFormat::kJson;
  std::string line = json ? absl::StrCat("\"message\":", Escaped(message)) : std::string(message);
  for (const LogField& field : fields) AppendField(json, field.key, field.value, &line);
  if (*suppressed > 0) AppendField(json, "suppressed", absl::StrCat(*suppressed), &line);
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
