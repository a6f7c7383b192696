#include "server/followers/recordings.h"

#include <stdlib.h>
#include <unistd.h>

#include <cerrno>
#include <filesystem>
#include <system_error>
#include <utility>

#include "absl/random/random.h"
#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/synchronization/notification.h"
#include "core/base/json.h"
#include "core/base/status_macros.h"
#include "core/dataset/recordings.h"
#include "server/base/log.h"

namespace spikeserve {
namespace {

// Returns the memory that an episode occupies.
int64_t BytesOf(const Dataset& dataset) {
  const Episode& episode = dataset.episodes[0];
  const ServedEpisode& served = *episode.served;
  size_t bytes = sizeof(Dataset) + sizeof(Episode);
  bytes += (episode.observations.size() + served.returns_to_go.size()) * sizeof(float);
  bytes += (served.probabilities.size() + 2 * served.noise.size()) * sizeof(float);
  bytes += episode.rewards.size() * sizeof(double) + served.spikes.size() * sizeof(uint64_t);
  const size_t elements = static_cast<size_t>(dataset.action_space.size());
  const size_t values = dataset.action_space.is_discrete() ? 0 : elements * sizeof(float);
  bytes += episode.actions.size() * (sizeof(Action) + values);
  for (const StepSource& source : served.sources) {
    bytes += sizeof(StepSource) + source.operator_id.size();
  }
  for (const auto& [key, value] : served.labels) bytes += key.size() + value.size();
  return static_cast<int64_t>(bytes);
}

}  // namespace

absl::StatusOr<std::unique_ptr<Recordings>> Recordings::Create(const std::string& directory,
                                                               int64_t max_bytes,
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
  return std::unique_ptr<Recordings>(new Recordings(directory, max_bytes, metrics));
}

Recordings::Recordings(const std::string& directory, int64_t max_bytes, Metrics* metrics)
    : metrics_(metrics),
      queued_bytes_(2 * kMostBytes),
      folder_(directory, max_bytes,
              [metrics](int64_t bytes, int64_t limit) {
                metrics->SetStoredBytes(StoredFolder::kRecordings, bytes, limit);
              }),
      worker_(kMostEpisodes) {}

std::string Recordings::NewName(const ServedPolicy& served) {
  return absl::StrFormat("%s-%d-%016x", served.name, served.version,
                         absl::Uniform<uint64_t>(absl::BitGen()));
}

std::unique_ptr<EpisodeRecorder> Recordings::Record(std::shared_ptr<const ServedPolicy> served,
                                                    const std::string& name,
                                                    const std::string& tenant) {
  return std::make_unique<EpisodeRecorder>(
      std::move(served),
      [this, name, tenant](Dataset episode) { return Submit(tenant, name, std::move(episode)); });
}

void Recordings::Drop(const std::string& tenant, RecordingOutcome reason) {
  metrics_->CountRecordedEpisode(reason);
  LogWarning("episode not recorded",
             {{"tenant", tenant},
              {"reason", reason == RecordingOutcome::kQueueFull
                             ? "more episodes of the tenant wait to be written than may"
                             : "--max_recorded_bytes: the tenant has its share of --record_dir"}});
}

RecordingTicket Recordings::Submit(const std::string& tenant, const std::string& name,
                                   Dataset episode) {
  const int64_t bytes = BytesOf(episode);
  // The file is about as long as the episode in memory.
  const auto on_disk = folder_.Take(tenant, bytes);
  if (on_disk == nullptr) {
    Drop(tenant, RecordingOutcome::kStorageFull);
    return nullptr;
  }
  auto queued = queued_bytes_.Take(tenant, bytes);
  const auto shared = std::make_shared<const Dataset>(std::move(episode));
  const auto state = std::make_shared<std::atomic<RecordingState>>(RecordingState::kQueued);
  const auto write = [this, name, shared, state, bytes, on_disk, queued] {
    const RecordingOutcome outcome = Write(name, *shared);
    const bool written = outcome == RecordingOutcome::kWritten;
    *state = written ? RecordingState::kStored : RecordingState::kNotRecorded;
    metrics_->AddRecordingQueue(-1, -bytes);
    metrics_->CountRecordedEpisode(outcome);
    if (written) folder_.Keep(*on_disk);
  };
  metrics_->AddRecordingQueue(1, bytes);
  if (queued != nullptr && worker_.Submit(tenant, write).ok()) return state;
  metrics_->AddRecordingQueue(-1, -bytes);
  Drop(tenant, RecordingOutcome::kQueueFull);
  return nullptr;
}

absl::StatusOr<Recordings::AmendedReturn> Recordings::Amend(const std::string& name,
                                                            const std::string& tenant,
                                                            int64_t episode,
                                                            const EpisodeAmendment& amendment) {
  const auto not_found = absl::NotFoundError(
      absl::StrCat("session_id: expected an open session, or a recording of this server, with "
                   "episode ",
                   episode, ", received ", Quoted(name)));
  // The caller chooses the name.
  const bool is_name = !name.empty() && name[0] != '.' && !absl::StrContains(name, '/') &&
                       !absl::StrContains(name, '\0') && episode >= 0;
  if (!is_name) return not_found;
  const std::string path = RecordingPath(folder_.directory(), name, episode);
  absl::StatusOr<AmendedReturn> amended = not_found;
  absl::Notification done;
  // Behind the episodes of the tenant that wait, of which it may be one.
  RETURN_IF_ERROR(worker_.Submit(tenant, [&] {
    if (std::error_code error; std::filesystem::exists(path, error)) {
      amended = AmendFile(path, tenant, amendment);
    }
    done.Notify();
  }));
  done.WaitForNotification();
  return absl::IsNotFound(amended.status()) ? not_found : amended;
}

absl::StatusOr<Recordings::AmendedReturn> Recordings::AmendFile(const std::string& path,
                                                                const std::string& tenant,
                                                                const EpisodeAmendment& amendment) {
  auto dataset = ReadDataset(path);
  if (!dataset.ok()) return absl::UnavailableError(dataset.status().message());
  const auto return_of = [&dataset] {
    double sum = 0.0;
    for (const double reward : dataset->episodes[0].rewards) sum += reward;
    return sum;
  };
  const auto& served = dataset->episodes[0].served;
  if (!served.has_value() || served->tenant != tenant) {
    return absl::NotFoundError("session_id: expected a recording of the caller");
  }
  auto read = ReadAmendments(path, &*dataset);
  if (!read.ok()) return absl::UnavailableError(read.status().message());
  std::vector<EpisodeAmendment> given = *std::move(read);
  AmendedReturn amended = {.before = return_of()};
  amended.after = amended.before;
  for (const EpisodeAmendment& before : given) {
    if (before.id != amendment.id) continue;
    if (before.digest == amendment.digest) return amended;
    return absl::AlreadyExistsError(absl::StrCat(
        "amendment_id: expected the same verdict as before, or another name, received another "
        "verdict of ",
        amendment.id));
  }
  RETURN_IF_ERROR(ApplyAmendment(amendment, &*dataset));
  const auto bytes = static_cast<int64_t>(AmendmentLine(amendment).size());
  const auto on_disk = folder_.Take(tenant, bytes);
  if (on_disk == nullptr) {
    return absl::ResourceExhaustedError(
        "--max_recorded_bytes: the tenant has its share of --record_dir");
  }
  given.push_back(amendment);
  RETURN_IF_ERROR(WriteAmendments(path, given));
  folder_.Keep(*on_disk);
  amended.after = return_of();
  amended.is_new = true;
  return amended;
}

RecordingOutcome Recordings::Write(const std::string& name, const Dataset& episode) {
  const std::string path =
      RecordingPath(folder_.directory(), name, episode.episodes[0].served->episode);
  const std::filesystem::path folder = std::filesystem::path(path).parent_path();
  std::error_code error;
  std::filesystem::create_directories(folder, error);
  const absl::Status status =
      error ? absl::UnavailableError(absl::StrCat(path, ": ", error.message()))
            : WriteDataset(episode, path);
  LogWritten(status);
  if (status.ok()) return RecordingOutcome::kWritten;
  rmdir(folder.c_str());  // fails unless it is empty
  return RecordingOutcome::kWriteFailed;
}

void Recordings::LogWritten(const absl::Status& status) {
  if (status.ok() && failed_in_a_row_ > 0) {
    LogInfo("recordings are written again", {{"lost", absl::StrCat(failed_in_a_row_)}});
  } else if (!status.ok() && failed_in_a_row_ == 0) {
    LogError("recordings are lost until the server can write them", {{"error", status.message()}});
  }
  failed_in_a_row_ = status.ok() ? 0 : failed_in_a_row_ + 1;
}

}  // namespace spikeserve
