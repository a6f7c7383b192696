#include "server/agent/recordings.h"

#include <stdlib.h>
#include <unistd.h>

#include <cerrno>
#include <filesystem>
#include <system_error>
#include <utility>

#include "absl/random/random.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "core/dataset/recordings.h"
#include "server/base/log.h"

namespace spikeserve {
namespace {

// The largest number of episodes that wait to be written.
constexpr size_t kLongestQueue = 4096;

}  // namespace

absl::StatusOr<std::unique_ptr<Recordings>> Recordings::Create(const std::string& directory,
                                                               Metrics* metrics) {
  std::error_code error;
  std::filesystem::create_directories(directory, error);
  // A recording is a folder. Creating one is the only check that also finds full and read-only file
  // systems, and what a superuser cannot do either.
  std::string probe = (std::filesystem::path(directory) / ".probe-XXXXXX").string();
  if (error || mkdtemp(probe.data()) == nullptr) {
    if (!error) error = std::error_code(errno, std::generic_category());
    return absl::FailedPreconditionError(absl::StrCat(
        "--record_dir: expected a directory in which the server can create folders, received ",
        directory, ": ", error.message(),
        ". Give the user of the server write access, or record into another directory"));
  }
  rmdir(probe.c_str());
  return std::unique_ptr<Recordings>(new Recordings(directory, metrics));
}

Recordings::Recordings(std::string directory, Metrics* metrics)
    : directory_(std::move(directory)), metrics_(metrics), worker_(kLongestQueue) {}

std::string Recordings::NewName(const ServedPolicy& served) {
  return absl::StrFormat("%s-%d-%016x", served.name, served.version,
                         absl::Uniform<uint64_t>(absl::BitGen()));
}

std::unique_ptr<EpisodeRecorder> Recordings::Record(std::shared_ptr<const ServedPolicy> served,
                                                    const std::string& name) {
  return std::make_unique<EpisodeRecorder>(
      std::move(served), [this, name](Dataset episode) { Submit(name, std::move(episode)); });
}

void Recordings::Submit(const std::string& name, Dataset episode) {
  const auto shared = std::make_shared<const Dataset>(std::move(episode));
  const absl::Status accepted = worker_.Submit(
      [this, name, shared] { metrics_->CountRecordedEpisode(Write(name, *shared)); });
  if (!accepted.ok()) metrics_->CountRecordedEpisode(RecordingOutcome::kQueueFull);
}

RecordingOutcome Recordings::Write(const std::string& name, const Dataset& episode) const {
  const std::string path = RecordingPath(directory_, name, episode.episodes[0].served->episode);
  std::error_code error;
  std::filesystem::create_directories(std::filesystem::path(path).parent_path(), error);
  const absl::Status status =
      error ? absl::UnavailableError(absl::StrCat(path, ": ", error.message()))
            : WriteDataset(episode, path);
  if (status.ok()) return RecordingOutcome::kWritten;
  LogError("recording lost", {{"error", status.message()}});
  return RecordingOutcome::kWriteFailed;
}

}  // namespace spikeserve
