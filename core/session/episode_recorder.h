// Records the episodes of one session while they are played.
//
// Not thread-safe: protected by the same lock as its session.
#ifndef CORE_SESSION_EPISODE_RECORDER_H_
#define CORE_SESSION_EPISODE_RECORDER_H_

#include <functional>
#include <memory>
#include <optional>

#include "absl/types/span.h"
#include "core/dataset/dataset.h"
#include "core/session/served_policy.h"
#include "core/session/session.h"

namespace spikeserve {

// Passes every finished episode to a sink.
class EpisodeRecorder {
 public:
  // A longer episode is cut off after this number of steps, to limit the memory that one client can
  // occupy.
  static constexpr int kLongestEpisode = 100'000;

  // Receives every episode of at least one complete step, as a dataset of one episode. A decision
  // may wait for the sink, so it must be quick and must never block.
  using Sink = std::function<void(Dataset)>;

  EpisodeRecorder(std::shared_ptr<const ServedPolicy> served, Sink sink);

  // Cuts off the running episode and passes it to the sink.
  ~EpisodeRecorder();
  EpisodeRecorder(const EpisodeRecorder&) = delete;
  EpisodeRecorder& operator=(const EpisodeRecorder&) = delete;

  // Records the answer that `session` has just given, its last_answer. `reward` was earned by the
  // action before it. Ignores decisions until the first step 0.
  void OnDecision(const Session& session, absl::Span<const float> observation, double reward);

  // Ends the running episode. `reward` and `observation` are the results of the last action; if
  // `observation` is empty, NaN is recorded in its place. An episode that has not terminated is
  // recorded as truncated.
  void OnEnd(double reward, absl::Span<const float> observation, bool terminated, bool truncated);

 private:
  void Start(const Session& session);
  void PassToSink();

  // Ends the running episode as truncated, without its last action, whose reward is not known.
  void CutOff();

  const std::shared_ptr<const ServedPolicy> served_;
  const Sink sink_;
  std::optional<Dataset> running_;  // of one episode; absent: none is being recorded
};

}  // namespace spikeserve

#endif  // CORE_SESSION_EPISODE_RECORDER_H_
