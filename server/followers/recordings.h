// Writes recorded episodes below --record_dir, on its own thread, so that no answer waits for the
// disk. At most kMostEpisodes episodes or kMostBytes bytes wait to be written: this is what a crash
// can lose. Episodes beyond it are dropped and counted.
//
// Thread-safe.
#ifndef SERVER_FOLLOWERS_RECORDINGS_H_
#define SERVER_FOLLOWERS_RECORDINGS_H_

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/agent/episode_recorder.h"
#include "core/agent/served_policy.h"
#include "server/base/background_worker.h"
#include "server/metrics/metrics.h"

namespace spikeserve {

class Recordings {
 public:
  static constexpr size_t kMostEpisodes = 4096;
  static constexpr int64_t kMostBytes = 256 << 20;

  // Creates `directory` if it does not exist. Returns INVALID_ARGUMENT if it cannot be written to.
  // `metrics` must outlive the returned object, which must outlive its recorders.
  static absl::StatusOr<std::unique_ptr<Recordings>> Create(const std::string& directory,
                                                            Metrics* metrics);

  // Returns a new name: <policy>-<version>-<16 random hexadecimal digits>.
  static std::string NewName(const ServedPolicy& served);

  // Returns a recorder that writes the episodes of one session below <directory>/<name>/.
  std::unique_ptr<EpisodeRecorder> Record(std::shared_ptr<const ServedPolicy> served,
                                          const std::string& name);

 private:
  Recordings(std::string directory, Metrics* metrics);

  // Queues an episode. Returns null if the queue is full.
  RecordingTicket Submit(const std::string& name, Dataset episode);
  // Returns false if the queue has no room for `bytes` more.
  bool Reserve(int64_t bytes);
  void Release(int64_t bytes);
  RecordingOutcome Write(const std::string& name, const Dataset& episode);
  // Writes a line when writing fails for the first time, and when it works again.
  void LogWritten(const absl::Status& status);

  const std::string directory_;
  Metrics* const metrics_;
  std::atomic<int64_t> queued_bytes_ = 0;
  int64_t failed_in_a_row_ = 0;  // of the worker's thread
  BackgroundWorker worker_;      // declared last, because its work uses the members above
};

}  // namespace spikeserve

#endif  // SERVER_FOLLOWERS_RECORDINGS_H_
