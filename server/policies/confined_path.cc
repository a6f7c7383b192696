#include "server/policies/confined_path.h"

#include <algorithm>
#include <system_error>

#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

namespace fs = std::filesystem;

bool IsWithin(const fs::path& directory, const fs::path& path) {
  return std::mismatch(directory.begin(), directory.end(), path.begin(), path.end()).first ==
         directory.end();
}

}  // namespace

absl::Status CheckWithin(const fs::path& directory, const fs::path& path) {
  std::error_code error;
  const fs::path base = fs::canonical(directory, error);
  if (error) return absl::OkStatus();
  const fs::path real = fs::canonical(path, error);
  if (error == std::errc::no_such_file_or_directory) return absl::OkStatus();
  if (!error && IsWithin(base, real)) return absl::OkStatus();
  return absl::InvalidArgumentError(absl::StrCat(
      path.string(), ": expected a file within ", directory.string(), ", received a symbolic link ",
      error ? "that leads nowhere" : "that leads out of it"));
}

}  // namespace spikeserve
