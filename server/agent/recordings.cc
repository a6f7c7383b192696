#include "server/agent/recordings.h"

#include <unistd.h>

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
  if (error || access(directory.c_str(), W_OK | X_OK) != 0) {
    return absl::InvalidArgumentError(
        absl::StrCat("--record_dir: expected a writable directory, received ", directory));
  }
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
