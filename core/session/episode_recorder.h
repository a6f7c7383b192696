// Collects the episodes of one session while they are played, for a file or whoever wants them.
//
// Not thread-safe: it is used where its session is.
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

class EpisodeRecorder {
 public:
  // An episode of more steps is cut off there, to bound what one client can make the server keep.
  static constexpr int kLongestEpisode = 100'000;

  // Gets every episode with at least one whole step, as a dataset of one. Called where a decision
  // may wait for it, so it must be quick and never block.
  using Sink = std::function<void(Dataset)>;

  EpisodeRecorder(std::shared_ptr<const ServedPolicy> served, Sink sink);

  // Hands in what was cut off.
  ~EpisodeRecorder();
  EpisodeRecorder(const EpisodeRecorder&) = delete;
  EpisodeRecorder& operator=(const EpisodeRecorder&) = delete;

  // `session` has just answered with its last_answer; `reward` was for the action before. Recording
  // begins with an episode.
  void OnDecision(const Session& session, absl::Span<const float> observation, double reward);

  // `reward` and `observation` are what the last action led to; without an observation the last one
  // is recorded as not a number. What has not terminated is recorded as truncated.
  void OnEnd(double reward, absl::Span<const float> observation, bool terminated, bool truncated);

 private:
  void Start(const Session& session);
  void HandIn();

  // Nobody will tell the last action's reward any more: the episode is recorded, truncated, up to
  // the observation before that action.
  void CutOff();

  const std::shared_ptr<const ServedPolicy> served_;
  const Sink sink_;
  std::optional<Dataset> running_;  // of one episode; absent where none is recorded
};

}  // namespace spikeserve

#endif  // CORE_SESSION_EPISODE_RECORDER_H_
