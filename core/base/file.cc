#include "core/base/file.h"

#include <fcntl.h>
#include <stdlib.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <sstream>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"

namespace spikeserve {
namespace {

// Owns a file descriptor and closes it on destruction.
class Descriptor {
 public:
  explicit Descriptor(int fd) : fd_(fd) {}
  ~Descriptor() {
    if (fd_ >= 0) close(fd_);
  }
  Descriptor(const Descriptor&) = delete;
  Descriptor& operator=(const Descriptor&) = delete;

  int get() const { return fd_; }

 private:
  const int fd_;
};

bool WriteAll(int fd, absl::string_view bytes) {
  while (!bytes.empty()) {
    const ssize_t written = write(fd, bytes.data(), bytes.size());
    if (written < 0 && errno == EINTR) continue;
    if (written < 0) return false;
    bytes.remove_prefix(static_cast<size_t>(written));
  }
  return true;
}

absl::Status WriteAndFlush(int fd, const std::string& path,
                           const std::vector<absl::string_view>& pieces) {
  for (const absl::string_view piece : pieces) {
    if (!WriteAll(fd, piece)) return SystemError("write", path);
  }
  // mkostemp creates files that only their owner can read, but policies and datasets are not
  // secret.
  if (fchmod(fd, 0644) != 0) return SystemError("set the permissions", path);
  if (fsync(fd) != 0) return SystemError("flush", path);
  return absl::OkStatus();
}

// Flushes the directory that contains `path`, so that a rename in it survives a crash.
absl::Status FlushDirectoryOf(const std::string& path) {
  const std::filesystem::path parent = std::filesystem::path(path).parent_path();
  const Descriptor directory(
      open(parent.empty() ? "." : parent.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC));
  if (directory.get() < 0 || fsync(directory.get()) != 0) {
    return SystemError("flush the directory", path);
  }
  return absl::OkStatus();
}

}  // namespace

absl::StatusOr<std::string> ReadFile(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  std::ostringstream content;
  // Inserting an empty stream buffer into a stream sets its failbit, so an empty file is handled
  // separately.
  if (file && file.peek() == std::ifstream::traits_type::eof() && !file.bad()) return std::string();
  if (file && content << file.rdbuf()) return std::move(content).str();
  return absl::NotFoundError(absl::StrCat(path, ": expected a file that can be read"));
}

absl::Status WriteFileAtomically(const std::string& path,
                                 const std::vector<absl::string_view>& pieces) {
  std::string temporary = path + ".XXXXXX";
  const Descriptor file(mkostemp(temporary.data(), O_CLOEXEC));
  if (file.get() < 0) return SystemError("create a temporary file", path);
  absl::Status status = WriteAndFlush(file.get(), path, pieces);
  if (status.ok() && rename(temporary.c_str(), path.c_str()) != 0) {
    status = SystemError("rename the temporary file", path);
  }
  if (!status.ok()) {
    unlink(temporary.c_str());
    return status;
  }
  return FlushDirectoryOf(path);
}

}  // namespace spikeserve
