#include "core/base/shared_bytes.h"

#include <fcntl.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>
#include <fstream>
#include <functional>
#include <string_view>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

// More than one try is needed only if another process deletes or damages the file meanwhile.
constexpr int kTries = 5;

// A file of another user could be truncated while it is mapped.
absl::Status CheckFolder(const std::string& folder) {
  struct stat found = {};
  if (stat(folder.c_str(), &found) != 0) return SystemError("find the folder", folder);
  const bool private_folder = S_ISDIR(found.st_mode) && found.st_uid == geteuid() &&
                              (found.st_mode & (S_IWGRP | S_IWOTH)) == 0;
  if (private_folder) return absl::OkStatus();
  return InvalidArgument(
      folder, "a folder that only this user can write",
      S_ISDIR(found.st_mode)
          ? absl::StrFormat("mode %o of user %d", found.st_mode & 07777, found.st_uid)
          : "a file");
}

// Writes the file unless another process writes it first. Readers never see a part of it.
absl::Status WriteOnce(const std::string& path, absl::string_view bytes) {
  std::string temporary = path + ".XXXXXX";
  const int descriptor = mkostemp(temporary.data(), O_CLOEXEC);
  if (descriptor < 0) return SystemError("create a file", path);
  close(descriptor);
  std::ofstream file(temporary, std::ios::binary);
  file.write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
  file.close();
  absl::Status status;
  if (!file) {
    status = SystemError("write", path);
  } else if (chmod(temporary.c_str(), S_IRUSR) != 0) {
    status = SystemError("set the permissions", path);
  } else if (link(temporary.c_str(), path.c_str()) != 0 && errno != EEXIST) {
    status = SystemError("name the file", path);
  }
  unlink(temporary.c_str());
  return status;
}

// Returns a mapping of the file, or null if its content is not `bytes`. NOT_FOUND without a file.
absl::StatusOr<std::shared_ptr<const char>> Map(const std::string& path, absl::string_view bytes) {
  const int descriptor = open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NOFOLLOW);
  if (descriptor < 0) return SystemError("open", path);
  struct stat found = {};
  const bool fits = fstat(descriptor, &found) == 0 && S_ISREG(found.st_mode) &&
                    found.st_uid == geteuid() && static_cast<size_t>(found.st_size) == bytes.size();
  void* const memory =
      fits ? mmap(nullptr, bytes.size(), PROT_READ, MAP_SHARED, descriptor, 0) : nullptr;
  const absl::Status failed = memory == MAP_FAILED ? SystemError("map", path) : absl::OkStatus();
  close(descriptor);
  if (!failed.ok()) return failed;
  if (!fits) return nullptr;
  const size_t size = bytes.size();
  std::shared_ptr<const char> mapped(static_cast<const char*>(memory), [size](const char* mapping) {
    munmap(const_cast<char*>(mapping), size);
  });
  return std::memcmp(mapped.get(), bytes.data(), size) == 0 ? mapped : nullptr;
}

}  // namespace

absl::StatusOr<std::shared_ptr<const char>> ShareBytes(const std::string& folder,
                                                       absl::string_view bytes) {
  if (bytes.empty()) return InvalidArgument("bytes", "at least one", "none");
  if (mkdir(folder.c_str(), S_IRWXU) != 0 && errno != EEXIST) {
    return SystemError("create the folder", folder);
  }
  RETURN_IF_ERROR(CheckFolder(folder));
  // A name for the content, which is compared: two contents of one name would only not be shared.
  const size_t hash = std::hash<std::string_view>()({bytes.data(), bytes.size()});
  const std::string path =
      absl::StrCat(folder, "/", absl::Hex(hash, absl::kZeroPad16), "-", bytes.size());
  for (int i = 0; i < kTries; ++i) {
    absl::StatusOr<std::shared_ptr<const char>> mapped = Map(path, bytes);
    if (mapped.ok() && *mapped != nullptr) return mapped;
    if (!mapped.ok() && !absl::IsNotFound(mapped.status())) return mapped.status();
    if (mapped.ok()) unlink(path.c_str());
    RETURN_IF_ERROR(WriteOnce(path, bytes));
  }
  return absl::AbortedError(absl::StrCat(path, ": expected the written content, received other"));
}

}  // namespace spikeserve
