#include "server/base/audit_log.h"

#include <fcntl.h>
#include <unistd.h>

#include <cerrno>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "core/base/file.h"
#include "core/base/json_object.h"
#include "nlohmann/json.hpp"
#include "server/base/log.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

constexpr char kTimeFormat[] = "%Y-%m-%dT%H:%M:%E3SZ";

// Returns the value of a text that holds JSON; null if it is empty or holds none.
Json ParseOrNull(const std::string& text) {
  Json json = Json::parse(text, /*cb=*/nullptr, /*allow_exceptions=*/false);
  return json.is_discarded() ? Json() : json;
}

std::string LineOf(const AuditEntry& entry) {
  const Json json = {
      {"time", absl::FormatTime(kTimeFormat, entry.time, absl::UTCTimeZone())},
      {"action", entry.action},
      {"token", entry.token},
      {"tenant", entry.tenant},
      {"certificate", entry.peer.certificate},
      {"address", entry.peer.address},
      {"policy", entry.policy},
      {"request", ParseOrNull(entry.request)},
      {"code", static_cast<int>(entry.outcome.code())},
      {"message", std::string(entry.outcome.message())},
      {"before", ParseOrNull(entry.before)},
      {"after", ParseOrNull(entry.after)},
  };
  return json.dump(/*indent=*/-1, /*indent_char=*/' ', /*ensure_ascii=*/true,
                   Json::error_handler_t::replace) +
         "\n";
}

std::string TextOf(const Json& json) { return json.is_null() ? "" : json.dump(); }

absl::StatusOr<AuditEntry> ParseLine(absl::string_view line) {
  const auto json = ParseJsonObject("entry", line);
  if (!json.ok()) return json.status();
  AuditEntry entry;
  std::string time;
  int code = 0;
  std::string message;
  Json request;
  Json before;
  Json after;
  JsonObject object("", *json);
  object.AllowOtherKeys();
  object.Required("time", &time);
  object.Required("action", &entry.action);
  object.Required("token", &entry.token);
  object.Required("tenant", &entry.tenant);
  object.Required("certificate", &entry.peer.certificate);
  object.Required("address", &entry.peer.address);
  object.Required("policy", &entry.policy);
  object.Required("request", &request);
  object.Required("code", &code, 0, 16);
  object.Required("message", &message);
  object.Required("before", &before);
  object.Required("after", &after);
  if (auto status = object.Finish(); !status.ok()) return status;
  std::string error;
  if (!absl::ParseTime(kTimeFormat, time, &entry.time, &error)) {
    return absl::InvalidArgumentError(absl::StrCat("time: ", error));
  }
  entry.request = TextOf(request);
  entry.outcome = absl::Status(static_cast<absl::StatusCode>(code), message);
  entry.before = TextOf(before);
  entry.after = TextOf(after);
  return entry;
}

// Appends `line` to the file and flushes it to the disk. One write() appends as a whole.
absl::Status Append(const std::string& path, absl::string_view line) {
  const int fd = open(path.c_str(), O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0640);
  if (fd < 0) return absl::ErrnoToStatus(errno, absl::StrCat(path, ": cannot open"));
  absl::Status status;
  if (write(fd, line.data(), line.size()) != static_cast<ssize_t>(line.size()) || fsync(fd) != 0) {
    status = absl::ErrnoToStatus(errno, absl::StrCat(path, ": cannot append"));
  }
  close(fd);
  return status;
}

}  // namespace

absl::StatusOr<std::unique_ptr<AuditLog>> AuditLog::Open(const std::string& path) {
  auto log = std::unique_ptr<AuditLog>(new AuditLog(path));
  if (path.empty()) return log;
  if (auto status = Append(path, ""); !status.ok()) {
    return absl::Status(status.code(),
                        absl::StrCat("--audit_log: expected a file that the server can append to: ",
                                     status.message()));
  }
  const auto text = ReadFile(path);
  if (!text.ok()) return text.status();
  absl::MutexLock lock(&log->mutex_);
  for (const absl::string_view line : absl::StrSplit(*text, '\n', absl::SkipEmpty())) {
    if (auto entry = ParseLine(line); entry.ok()) log->Remember(*std::move(entry));
  }
  return log;
}

void AuditLog::Remember(AuditEntry entry) {
  entries_.push_back(std::move(entry));
  if (entries_.size() > kRemembered) entries_.pop_front();
}

void AuditLog::Record(AuditEntry entry) {
  const std::string code = absl::StatusCodeToString(entry.outcome.code());
  LogInfo("operator action", {{"action", entry.action},
                              {"token", entry.token},
                              {"tenant", entry.tenant},
                              {"certificate", entry.peer.certificate},
                              {"address", entry.peer.address},
                              {"policy", entry.policy},
                              {"request", entry.request},
                              {"code", code},
                              {"error", entry.outcome.message()},
                              {"before", entry.before},
                              {"after", entry.after}});
  absl::MutexLock lock(&mutex_);
  if (!path_.empty()) {
    if (auto status = Append(path_, LineOf(entry)); !status.ok()) {
      LogError("operator action not recorded", {{"error", status.message()}});
    }
  }
  Remember(std::move(entry));
}

std::vector<AuditEntry> AuditLog::Last(absl::FunctionRef<bool(const AuditEntry&)> wanted,
                                       size_t limit) const {
  absl::MutexLock lock(&mutex_);
  std::vector<AuditEntry> last;
  for (auto it = entries_.rbegin(); it != entries_.rend() && last.size() < limit; ++it) {
    if (wanted(*it)) last.push_back(*it);
  }
  return last;
}

}  // namespace spikeserve
