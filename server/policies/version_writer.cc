#include "server/policies/version_writer.h"

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

#include "absl/functional/function_ref.h"
#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "core/base/file.h"
#include "core/base/status_macros.h"
#include "server/policies/confined_path.h"

namespace spikeserve {
namespace {

namespace fs = std::filesystem;

constexpr char kUnfinished[] = ".unfinished-";
constexpr char kPolicyFile[] = "policy.safetensors";
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

int64_t NextVersion(const fs::path& policy_folder) {
  int64_t highest = 0;
  for (const fs::directory_entry& entry : Entries(policy_folder)) {
    const auto version = ParseVersion(entry.path());
    if (version.ok()) highest = std::max(highest, *version);
  }
  return highest + 1;
}

// Writes the files of a version into a hidden folder of the policy and renames it to the number
// that `number` returns then.
absl::Status WriteAndRename(const std::string& directory, const std::string& name,
                            const VersionFiles& files, absl::FunctionRef<int64_t()> number) {
  const fs::path policy_folder = fs::path(directory) / name;
  RETURN_IF_ERROR(CheckWithin(directory, policy_folder));
  std::string folder = (policy_folder / absl::StrCat(kUnfinished, "XXXXXX")).string();
  if (mkdtemp(folder.data()) == nullptr) return SystemError(folder, "create the folder");
  const OpenFolder in_use(folder);
  in_use.Lock();
  const std::string path = (fs::path(folder) / kPolicyFile).string();
  auto status = WriteFileAtomically(path, {files.policy});
  if (status.ok() && !files.signature.empty()) {
    status = WriteFileAtomically(SignaturePath(path), {files.signature});
  }
  std::error_code ignored;
  fs::permissions(folder, fs::perms(0755), ignored);  // mkdtemp lets only the owner read it
  const fs::path target = policy_folder / absl::StrCat(number());
  if (status.ok() && rename(folder.c_str(), target.c_str()) != 0) {
    status = SystemError(target, "create the folder");
  }
  if (!status.ok()) {
    fs::remove_all(folder, ignored);
    return status;
  }
  if (!OpenFolder(policy_folder).Flush()) return SystemError(policy_folder, "flush the directory");
  return absl::OkStatus();
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

int64_t NextVersion(const std::string& directory, const std::string& name) {
  return NextVersion(fs::path(directory) / name);
}

absl::Status WriteVersion(const std::string& directory, const PolicyVersion& version,
                          const VersionFiles& files) {
  const fs::path policy_folder = fs::path(directory) / version.policy;
  std::error_code ignored;
  fs::create_directories(policy_folder, ignored);
  return WriteAndRename(directory, version.policy, files, [&] { return version.version; });
}

absl::StatusOr<PolicyVersion> WriteNewVersion(const std::string& directory, const std::string& name,
                                              const VersionFiles& files) {
  PolicyVersion written = {.policy = name, .version = 0};
  RETURN_IF_ERROR(WriteAndRename(directory, name, files,
                                 [&] { return written.version = NextVersion(directory, name); }));
  return written;
}

void SweepUnfinishedVersions(const std::string& directory) {
  for (const fs::directory_entry& policy : Entries(directory)) {
    if (!CheckWithin(directory, policy.path()).ok()) continue;
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
