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
#include <utility>
#include <vector>

#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "core/base/file.h"
#include "core/model/policy_file.h"

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

// Writes the policy into `folder` and renames the folder to the next version.
absl::StatusOr<int64_t> WriteAndRename(const Policy& policy, const fs::path& folder) {
  if (auto status = WritePolicyFile(policy, (folder / kPolicyFile).string()); !status.ok()) {
    return status;
  }
  std::error_code error;
  fs::permissions(folder, fs::perms(0755), error);  // mkdtemp lets only the owner read it
  const fs::path policy_folder = folder.parent_path();
  const int64_t version = NextVersion(policy_folder);
  if (rename(folder.c_str(), (policy_folder / absl::StrCat(version)).c_str()) != 0) {
    return SystemError(folder, "rename the folder");
  }
  if (!OpenFolder(policy_folder).Flush()) return SystemError(policy_folder, "flush the directory");
  return version;
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
    const bool is_temporary = absl::StartsWith(name, absl::StrCat(kPolicyFile, "."));
    if (is_temporary && IsOld(file.path())) fs::remove(file.path(), ignored);
  }
  rmdir(folder.c_str());  // fails unless the folder is empty
}

}  // namespace

int64_t NextVersion(const std::string& directory, const std::string& name) {
  return NextVersion(fs::path(directory) / name);
}

absl::Status WriteVersion(const std::string& directory, const PolicyVersion& version,
                          const std::string& bytes, const std::string& sha256) {
  if (const std::string received = Sha256Of(bytes); received != sha256) {
    return absl::InvalidArgumentError(
        absl::StrCat("policy file: expected SHA-256 ", sha256, ", received ", received));
  }
  const fs::path policy_folder = fs::path(directory) / version.policy;
  std::error_code error;
  fs::create_directories(policy_folder, error);
  std::string folder = (policy_folder / absl::StrCat(kUnfinished, "XXXXXX")).string();
  if (mkdtemp(folder.data()) == nullptr) return SystemError(folder, "create the folder");
  const OpenFolder in_use(folder);
  in_use.Lock();
  auto status = WriteFileAtomically((fs::path(folder) / kPolicyFile).string(), {bytes});
  fs::permissions(folder, fs::perms(0755), error);
  const fs::path target = policy_folder / absl::StrCat(version.version);
  if (status.ok() && rename(folder.c_str(), target.c_str()) != 0) {
    status = SystemError(target, "create the folder");
  }
  if (!status.ok()) fs::remove_all(folder, error);
  return status;
}

absl::StatusOr<std::string> PolicyFileBytes(const std::string& directory, const std::string& name,
                                            const Policy& policy) {
  std::string folder = (fs::path(directory) / name / absl::StrCat(kUnfinished, "XXXXXX")).string();
  if (mkdtemp(folder.data()) == nullptr) return SystemError(folder, "create the folder");
  const std::string path = (fs::path(folder) / kPolicyFile).string();
  const auto written = WritePolicyFile(policy, path);
  auto bytes = written.ok() ? ReadFile(path) : absl::StatusOr<std::string>(written);
  std::error_code ignored;
  fs::remove_all(folder, ignored);
  return bytes;
}

absl::StatusOr<PolicyVersion> WriteNewVersion(const std::string& directory, const std::string& name,
                                              const Policy& policy) {
  std::string folder = (fs::path(directory) / name / absl::StrCat(kUnfinished, "XXXXXX")).string();
  if (mkdtemp(folder.data()) == nullptr) return SystemError(folder, "create the folder");
  const OpenFolder in_use(folder);
  in_use.Lock();
  const auto version = WriteAndRename(policy, folder);
  if (version.ok()) return PolicyVersion{.policy = name, .version = *version};
  std::error_code ignored;
  fs::remove_all(folder, ignored);
  return version.status();
}

void SweepUnfinishedVersions(const std::string& directory) {
  for (const fs::directory_entry& policy : Entries(directory)) {
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
