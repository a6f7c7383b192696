#include "server/admin/audit_log.h"

#include <fcntl.h>
#include <sys/file.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <sys/statvfs.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstdio>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "core/base/file.h"
#include "core/base/json_object.h"
#include "core/base/status_macros.h"
#include "nlohmann/json.hpp"
#include "server/base/log.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

// Room on the disk behind the lines, which is kept for those of operators.
constexpr size_t kReserveBytes = 1 << 20;

// Of the file with the calls of agents, of which the one before is kept.
constexpr off_t kAgentsBytes = 8 << 20;

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
  ASSIGN_OR_RETURN(const auto json, ParseJsonObject("entry", line));
  AuditEntry entry;
  std::string time;
  int code = 0;
  std::string message;
  Json request;
  Json before;
  Json after;
  JsonObject object("", json);
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
  RETURN_IF_ERROR(object.Finish());
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

// The file, locked against other servers that append to it.
class LockedFile {
 public:
  explicit LockedFile(const std::string& path)
      : path_(path), fd_(open(path.c_str(), O_RDWR | O_APPEND | O_CREAT | O_CLOEXEC, 0640)) {}
  ~LockedFile() {
    if (fd_ >= 0) close(fd_);
  }
  LockedFile(const LockedFile&) = delete;
  LockedFile& operator=(const LockedFile&) = delete;

  // Locks the file and removes what an interrupted write has left at its end. To be called first.
  absl::Status Prepare() {
    if (fd_ < 0) return Error("open");
    if (flock(fd_, LOCK_EX) != 0) return Error("lock");
    size_ = lseek(fd_, 0, SEEK_END);
    if (size_ < 0) return Error("read");
    return RemoveTornLine();
  }

  // Makes sure that `bytes` more fit, and, if there is room, the reserve behind them.
  absl::Status MakeRoom(size_t bytes) {
    const bool has_reserve =
        fallocate(fd_, FALLOC_FL_KEEP_SIZE, size_, static_cast<off_t>(bytes + kReserveBytes)) == 0;
    struct rlimit limit = {};
    if (getrlimit(RLIMIT_FSIZE, &limit) == 0 && limit.rlim_cur != RLIM_INFINITY &&
        static_cast<rlim_t>(size_) + bytes > limit.rlim_cur) {
      errno = EFBIG;
      return Error("append");
    }
    if (has_reserve || bytes == 0 ||
        fallocate(fd_, FALLOC_FL_KEEP_SIZE, size_, static_cast<off_t>(bytes)) == 0) {
      return absl::OkStatus();
    }
    // Some file systems cannot reserve room.
    struct statvfs disk = {};
    const bool can_reserve = errno != EOPNOTSUPP && errno != ENOSYS && errno != EINVAL;
    if (!can_reserve && fstatvfs(fd_, &disk) == 0 && disk.f_bavail * disk.f_frsize >= bytes) {
      return absl::OkStatus();
    }
    if (!can_reserve) errno = ENOSPC;
    return Error("append");
  }

  // Appends a line as a whole, or nothing of it.
  absl::Status Append(absl::string_view line) {
    RETURN_IF_ERROR(Write(line));
    return fsync(fd_) == 0 ? absl::OkStatus() : TakeBack(Error("flush"));
  }

  // As Append, but does not wait until the line is on the disk.
  absl::Status Write(absl::string_view line) {
    for (absl::string_view left = line; !left.empty();) {
      const ssize_t written = write(fd_, left.data(), left.size());
      if (written <= 0) return TakeBack(Error("append"));
      left.remove_prefix(static_cast<size_t>(written));
    }
    return absl::OkStatus();
  }

 private:
  absl::Status Error(absl::string_view what) const {
    return absl::ErrnoToStatus(errno, absl::StrCat(path_, ": cannot ", what));
  }

  absl::Status TakeBack(absl::Status status) const {
    if (ftruncate(fd_, size_) != 0) status = Error("remove a part of a line");
    return status;
  }

  // A line is torn if it has no end. One that an editor has left without an end is kept.
  absl::Status RemoveTornLine() {
    std::string tail;
    off_t begin = size_;
    while (begin > 0 && tail.find('\n') == std::string::npos) {
      const off_t length = std::min<off_t>(begin, kTailBytes);
      std::string block(static_cast<size_t>(length), '\0');
      begin -= length;
      if (pread(fd_, block.data(), block.size(), begin) != length) return Error("read");
      tail.insert(0, block);
    }
    const std::string torn = tail.substr(tail.rfind('\n') + 1);
    if (torn.empty()) return absl::OkStatus();
    if (ParseLine(torn).ok()) {
      RETURN_IF_ERROR(Append("\n"));
      ++size_;
      return absl::OkStatus();
    }
    size_ -= static_cast<off_t>(torn.size());
    if (ftruncate(fd_, size_) != 0) return Error("remove a part of a line");
    LogWarning("torn line removed", {{"path", path_}, {"line", torn}});
    return absl::OkStatus();
  }

  static constexpr off_t kTailBytes = 4096;

  const std::string path_;
  const int fd_;
  off_t size_ = 0;
};

}  // namespace

absl::StatusOr<std::unique_ptr<AuditLog>> AuditLog::Open(const std::string& path) {
  auto log = std::unique_ptr<AuditLog>(new AuditLog(path));
  if (path.empty()) return log;
  absl::MutexLock lock(&log->mutex_);
  if (auto status = log->Append(""); !status.ok()) {
    return absl::Status(status.code(),
                        absl::StrCat("--audit_log: expected a file that the server can append to: ",
                                     status.message()));
  }
  if (auto status = log->AppendOfAgent(""); !status.ok()) {
    LogWarning("calls of agents cannot be recorded", {{"error", status.message()}});
  }
  ASSIGN_OR_RETURN(const auto text, ReadFile(path));
  for (const absl::string_view line : absl::StrSplit(text, '\n', absl::SkipEmpty())) {
    if (auto entry = ParseLine(line); entry.ok()) log->Remember(*std::move(entry));
  }
  return log;
}

absl::Status AuditLog::Append(absl::string_view line) {
  LockedFile file(path_);
  RETURN_IF_ERROR(file.Prepare());
  RETURN_IF_ERROR(file.MakeRoom(line.size() + reserved_));
  return file.Append(line);
}

absl::Status AuditLog::AppendOfAgent(absl::string_view line) {
  const std::string path = absl::StrCat(path_, ".agents");
  absl::MutexLock lock(&agents_mutex_);
  struct stat now = {};
  if (stat(path.c_str(), &now) == 0 && now.st_size >= kAgentsBytes) {
    // Another server that has the file open goes on in the renamed one with one line at most.
    (void)rename(path.c_str(), absl::StrCat(path, ".1").c_str());
  }
  LockedFile file(path);
  RETURN_IF_ERROR(file.Prepare());
  return file.Write(line);
}

absl::Status AuditLog::Reserve(size_t bytes) {
  if (path_.empty()) return absl::OkStatus();
  absl::MutexLock lock(&mutex_);
  reserved_ += bytes;
  const auto status = Append("");
  if (status.ok()) return status;
  reserved_ -= bytes;
  LogError("no room to record an action", {{"error", status.message()}});
  return absl::UnavailableError(absl::StrCat(
      "--audit_log: expected room for a line, so nothing was changed: ", status.message()));
}

void AuditLog::Remember(AuditEntry entry) {
  const auto size_of = [](const AuditEntry& kept) {
    return kept.request.size() + kept.before.size() + kept.after.size();
  };
  remembered_bytes_ += size_of(entry);
  entries_.push_back(std::move(entry));
  while (entries_.size() > kRemembered ||
         (remembered_bytes_ > kRememberedBytes && entries_.size() > 1)) {
    remembered_bytes_ -= size_of(entries_.front());
    entries_.pop_front();
  }
}

absl::Status AuditLog::Record(AuditEntry entry, size_t reserved) {
  const std::string code = absl::StatusCodeToString(entry.outcome.code());
  const absl::string_view kind = entry.is_operators ? "operator action" : "agent action";
  LogInfo(kind, {{"action", entry.action},
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
  auto status = entry.is_operators ? RecordOfOperator(std::move(entry), reserved)
                : path_.empty()    ? absl::OkStatus()
                                   : AppendOfAgent(LineOf(entry));
  if (status.ok()) return status;
  LogError(absl::StrCat(kind, " not recorded"), {{"error", status.message()}});
  return absl::DataLossError(
      absl::StrCat("--audit_log: expected to record the action, which has ended with ", code, ": ",
                   status.message()));
}

absl::Status AuditLog::RecordOfOperator(AuditEntry entry, size_t reserved) {
  absl::MutexLock lock(&mutex_);
  reserved_ -= reserved;
  absl::Status status;
  if (!path_.empty()) status = Append(LineOf(entry));
  if (!status.ok()) {
    AuditEntry without_states = entry;
    without_states.before.clear();
    without_states.after.clear();
    status = Append(LineOf(without_states));
  }
  Remember(std::move(entry));
  return status;
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
