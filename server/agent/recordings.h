// Writes recorded episodes below --record_dir, on its own thread, so that no answer waits for the
// disk. If the queue is full, episodes are dropped and counted.
//
// Thread-safe.
#ifndef SERVER_AGENT_RECORDINGS_H_
#define SERVER_AGENT_RECORDINGS_H_

#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "core/session/episode_recorder.h"
#include "core/session/served_policy.h"
#include "server/base/background_worker.h"
#include "server/metrics/metrics.h"

namespace spikeserve {

class Recordings {
 public:
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

  void Submit(const std::string& name, Dataset episode);
  RecordingOutcome Write(const std::string& name, const Dataset& episode) const;

  const std::string directory_;
  Metrics* const metrics_;
  BackgroundWorker worker_;  // declared last, because its work uses the members above
};

}  // namespace spikeserve

#endif  // SERVER_AGENT_RECORDINGS_H_
