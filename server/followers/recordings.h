// Writes recorded episodes below --record_dir, on its own thread, so that no answer waits for the
// disk. At most kMostEpisodes episodes of a tenant, and kMostBytes bytes of all, wait to be
// written: this is what a crash can lose. Tenants take turns, and divide these bytes and those on
// the disk (SharedFolder). Episodes beyond it are dropped, counted and logged.
//
// Thread-safe.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/agent/episode_recorder.h"
#include "core/agent/served_policy.h"
#include "core/dataset/amendments.h"
#include "server/base/background_worker.h"
#include "server/base/shared_folder.h"
#include "server/base/shared_places.h"
#include "server/metrics/metrics.h"

namespace spikeserve {

class Recordings {
 public:
  static constexpr size_t kMostEpisodes = 4096;
  static constexpr int64_t kMostBytes = 256 << 20;

  // Creates `directory` if it does not exist. Returns INVALID_ARGUMENT if it cannot be written to.
  // It holds at most `max_bytes`. `metrics` must outlive the returned object, which must outlive
  // its recorders.
  static absl::StatusOr<std::unique_ptr<Recordings>> Create(const std::string& directory,
                                                            int64_t max_bytes, Metrics* metrics);

  // Returns a new name: <policy>-<version>-<16 random hexadecimal digits>.
  static std::string NewName(const ServedPolicy& served);

  // Returns a recorder that writes the episodes of one session of `tenant` below
  // <directory>/<name>/.
  std::unique_ptr<EpisodeRecorder> Record(std::shared_ptr<const ServedPolicy> served,
                                          const std::string& name, const std::string& tenant);

  // The return of a recorded episode, before and after an amendment.
  struct AmendedReturn {
    double before = 0.0;
    double after = 0.0;
    bool is_new = false;  // false: the recording had the amendment
  };
  // Adds a line to a recorded episode of `tenant`, once those of it that wait are written. Blocks.
  // NOT_FOUND: the tenant has no such recording on this server; ALREADY_EXISTS: it has another
  // amendment of this id; INVALID_ARGUMENT: as ApplyAmendment; RESOURCE_EXHAUSTED: no room;
  // UNAVAILABLE: the disk, or the queue.
  absl::StatusOr<AmendedReturn> Amend(const std::string& name, const std::string& tenant,
                                      int64_t episode, const EpisodeAmendment& amendment);

 private:
  Recordings(const std::string& directory, int64_t max_bytes, Metrics* metrics);

  // Queues an episode. Returns null if the tenant has no room in the queue or on the disk.
  RecordingTicket Submit(const std::string& tenant, const std::string& name, Dataset episode);
  // Counts and logs an episode that is dropped.
  void Drop(const std::string& tenant, RecordingOutcome reason);
  // As Amend, of a file that is written.
  absl::StatusOr<AmendedReturn> AmendFile(const std::string& path, const std::string& tenant,
                                          const EpisodeAmendment& amendment);
  RecordingOutcome Write(const std::string& name, const Dataset& episode);
  // Writes a line when writing fails for the first time, and when it works again.
  void LogWritten(const absl::Status& status);

  Metrics* const metrics_;
  SharedPlaces queued_bytes_;
  SharedFolder folder_;
  int64_t failed_in_a_row_ = 0;  // of the worker's thread
  BackgroundWorker worker_;      // declared last, because its work uses the members above
};

}  // namespace spikeserve
