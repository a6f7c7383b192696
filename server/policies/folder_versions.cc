// How a PolicyFolder adds and removes versions.
#include <fcntl.h>
#include <stdlib.h>
#include <sys/file.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <cstdint>
#include <filesystem>
#include <system_error>
#include <vector>

#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "core/base/file.h"
#include "core/base/status_macros.h"
#include "server/policies/confined_path.h"
#include "server/policies/policy_folder.h"

namespace spikeserve {
namespace {

namespace fs = std::filesystem;

constexpr char kUnfinished[] = ".unfinished-";
constexpr char kPolicyFile[] = "policy.safetensors";
constexpr char kPushedFile[] = "pushed";
constexpr std::chrono::minutes kTemporaryFileAge(10);

// A folder that is open. With Lock() it tells other processes that it is in use, until it is closed
// or the process ends.
class OpenFolder {
 public:
  explicit OpenFolder(const fs::path& path)
      : fd_(open(path.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC)) {}
  ~OpenFolder() {
    if (fd_ >= 0) close(fd_);
  }
  OpenFolder(const OpenFolder&) = delete;
  OpenFolder& operator=(const OpenFolder&) = delete;

  // Returns false if another process has locked the folder.
  bool Lock() const { return fd_ >= 0 && flock(fd_, LOCK_EX | LOCK_NB) == 0; }
  bool Flush() const { return fd_ >= 0 && fsync(fd_) == 0; }

 private:
  const int fd_;
};

absl::Status SystemError(const fs::path& path, absl::string_view what) {
  return absl::ErrnoToStatus(errno, absl::StrCat(path.string(), ": cannot ", what));
}

// Returns the entries of a folder; none if it cannot be read.
std::vector<fs::directory_entry> Entries(const fs::path& folder) {
  std::error_code error;
  std::vector<fs::directory_entry> entries;
  fs::directory_iterator it(folder, error);
  for (; !error && it != fs::directory_iterator(); it.increment(error)) entries.push_back(*it);
  return entries;
}

absl::StatusOr<std::string> MakeHiddenFolder(const fs::path& policy_folder) {
  std::string folder = (policy_folder / absl::StrCat(kUnfinished, "XXXXXX")).string();
  if (mkdtemp(folder.data()) == nullptr) return SystemError(folder, "create the folder");
  return folder;
}

bool IsOld(const fs::path& path) {
  std::error_code error;
  const auto written = fs::last_write_time(path, error);
  return !error && fs::file_time_type::clock::now() - written > kTemporaryFileAge;
}

void SweepVersion(const fs::path& folder) {
  std::error_code ignored;
  for (const fs::directory_entry& file : Entries(folder)) {
    const std::string name = file.path().filename().string();
    const bool is_temporary = absl::StartsWith(name, absl::StrCat(kPolicyFile, ".")) &&
                              name != SignaturePath(kPolicyFile);
    if (is_temporary && IsOld(file.path())) fs::remove(file.path(), ignored);
  }
  rmdir(folder.c_str());  // fails unless the folder is empty
}

}  // namespace

absl::Status PolicyFolder::Write(const PolicyVersion& version, const VersionFiles& files) const {
  const fs::path policy_folder = fs::path(directory_) / version.policy;
  RETURN_IF_ERROR(CheckWithin(directory_, policy_folder));
  std::error_code ignored;
  fs::create_directories(policy_folder, ignored);
  ASSIGN_OR_RETURN(const std::string folder, MakeHiddenFolder(policy_folder));
  const OpenFolder in_use(folder);
  in_use.Lock();
  const std::string path = (fs::path(folder) / kPolicyFile).string();
  auto status = WriteFileAtomically(path, {files.policy});
  if (status.ok() && !files.signature.empty()) {
    status = WriteFileAtomically(SignaturePath(path), {files.signature});
  }
  if (status.ok() && files.pushed) {
    status = WriteFileAtomically((fs::path(folder) / kPushedFile).string(), {});
  }
  fs::permissions(folder, fs::perms(0755), ignored);  // mkdtemp lets only the owner read it
  const fs::path target = policy_folder / absl::StrCat(version.version);
  if (status.ok() && rename(folder.c_str(), target.c_str()) != 0) {
    status = SystemError(target, "create the folder");
  }
  if (!status.ok()) {
    fs::remove_all(folder, ignored);
    rmdir(policy_folder.c_str());  // fails unless the folder is empty
    return status;
  }
  if (!OpenFolder(policy_folder).Flush()) return SystemError(policy_folder, "flush the directory");
  return absl::OkStatus();
}

absl::StatusOr<int64_t> PolicyFolder::Remove(const PolicyVersion& version) const {
  const fs::path policy_folder = fs::path(directory_) / version.policy;
  const fs::path folder = policy_folder / absl::StrCat(version.version);
  RETURN_IF_ERROR(CheckWithin(directory_, folder));
  int64_t bytes = 0;
  for (const fs::directory_entry& file : Entries(folder)) {
    std::error_code error;
    const auto size = file.file_size(error);
    if (!error) bytes += static_cast<int64_t>(size);
  }
  // The folder takes the place of an empty hidden one, which the next start sweeps if need be.
  ASSIGN_OR_RETURN(const std::string hidden, MakeHiddenFolder(policy_folder));
  if (rename(folder.c_str(), hidden.c_str()) != 0) {
    auto status = SystemError(folder, "remove the folder");
    rmdir(hidden.c_str());
    return status;
  }
  std::error_code ignored;
  fs::remove_all(hidden, ignored);
  if (rmdir(policy_folder.c_str()) != 0) OpenFolder(policy_folder).Flush();
  return bytes;
}

bool PolicyFolder::IsPushed(const PolicyVersion& version) const {
  const fs::path file = fs::path(PathOf(version)).replace_filename(kPushedFile);
  std::error_code error;
  return fs::exists(file, error) && CheckWithin(directory_, file).ok();
}

std::vector<int64_t> PolicyFolder::VersionsOf(const std::string& policy) const {
  std::vector<int64_t> versions;
  for (const fs::directory_entry& entry : Entries(fs::path(directory_) / policy)) {
    if (const auto version = ParseVersion(entry.path()); version.ok()) {
      versions.push_back(*version);
    }
  }
  std::sort(versions.begin(), versions.end());
  return versions;
}

std::vector<PolicyVersion> PolicyFolder::PushedVersions(const std::string& policy) const {
  std::vector<PolicyVersion> pushed;
  for (const int64_t number : VersionsOf(policy)) {
    const PolicyVersion version = {.policy = policy, .version = number};
    if (IsPushed(version)) pushed.push_back(version);
  }
  return pushed;
}

void PolicyFolder::Sweep() const {
  for (const fs::directory_entry& policy : Entries(directory_)) {
    if (!CheckWithin(directory_, policy.path()).ok()) continue;
    for (const fs::directory_entry& folder : Entries(policy.path())) {
      const fs::path& path = folder.path();
      std::error_code ignored;
      if (absl::StartsWith(path.filename().native(), kUnfinished)) {
        if (OpenFolder(path).Lock()) fs::remove_all(path, ignored);
      } else if (ParseVersion(path).ok() && !folder.is_symlink(ignored)) {
        SweepVersion(path);
      }
    }
  }
}

}  // namespace spikeserve
