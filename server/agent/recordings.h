// Writes recorded episodes below --record_dir, in a thread of its own, so that no answer waits for
// a disk. What it cannot keep up with is dropped and counted.
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
  // Makes `directory` if need be. `metrics` must outlive the recordings, and these the recorders.
  static absl::StatusOr<std::unique_ptr<Recordings>> Create(const std::string& directory,
                                                            Metrics* metrics);

  // A name that no recording has yet.
  static std::string NewName(const ServedPolicy& served);

  // Records a session below <directory>/<name>/.
  std::unique_ptr<EpisodeRecorder> Record(std::shared_ptr<const ServedPolicy> served,
                                          const std::string& name);

 private:
  Recordings(std::string directory, Metrics* metrics);

  void Submit(const std::string& name, Dataset episode);
  RecordingOutcome Write(const std::string& name, const Dataset& episode) const;

  const std::string directory_;
  Metrics* const metrics_;
  BackgroundWorker worker_;  // last: its work uses everything above
};

}  // namespace spikeserve

#endif  // SERVER_AGENT_RECORDINGS_H_
