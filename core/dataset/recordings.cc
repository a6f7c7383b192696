#include "core/dataset/recordings.h"

#include <algorithm>
#include <filesystem>
#include <system_error>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

namespace fs = std::filesystem;

absl::StatusOr<std::vector<std::string>> ListFiles(const std::string& path) {
  std::error_code error;
  if (fs::is_regular_file(path, error)) return std::vector<std::string>{path};
  std::vector<std::string> files;
  fs::recursive_directory_iterator it(path, error);
  for (; !error && it != fs::recursive_directory_iterator(); it.increment(error)) {
    if (it->path().extension() == ".cbor") files.push_back(it->path().string());
  }
  if (error) return absl::NotFoundError(absl::StrCat(path, ": ", error.message()));
  std::sort(files.begin(), files.end());
  return files;
}

}  // namespace

std::string RecordingPath(absl::string_view directory, absl::string_view recording,
                          int64_t episode) {
  return absl::StrFormat("%s/%s/%06d.cbor", directory, recording, episode);
}

absl::StatusOr<std::vector<Dataset>> ReadRecordings(const std::string& path,
                                                    absl::string_view environment) {
  ASSIGN_OR_RETURN(const auto files, ListFiles(path));
  std::vector<Dataset> datasets;
  for (const std::string& file : files) {
    ASSIGN_OR_RETURN(auto dataset, ReadDataset(file));
    if (environment.empty() || dataset.environment == environment) {
      datasets.push_back(std::move(dataset));
    }
  }
  if (!datasets.empty()) return datasets;
  const std::string what = environment.empty() ? "" : absl::StrCat(" of ", environment);
  return absl::NotFoundError(
      absl::StrCat(path, ": expected recorded episodes", what, ", received none"));
}

}  // namespace spikeserve
