// Records the episodes of one session while they are played.
//
// Not thread-safe: protected by the same lock as its session.
#ifndef CORE_SESSION_EPISODE_RECORDER_H_
#define CORE_SESSION_EPISODE_RECORDER_H_

#include <atomic>
#include <functional>
#include <memory>
#include <optional>

#include "absl/types/span.h"
#include "core/dataset/dataset.h"
#include "core/session/served_policy.h"
#include "core/session/session.h"

namespace spikeserve {

// Where the recording of an episode is.
enum class RecordingState {
  kNotRecorded,  // nowhere, for example because it was lost
  kQueued,       // in memory; a crash loses it
  kStored,       // on the disk
};

// Follows the recording of one episode. Thread-safe.
using RecordingTicket = std::shared_ptr<const std::atomic<RecordingState>>;

// Passes every finished episode to a sink.
class EpisodeRecorder {
 public:
  // A longer episode is cut off after this number of steps, to limit the memory that one client can
  // occupy.
  static constexpr int kLongestEpisode = 100'000;

  // Receives every episode of at least one complete step, as a dataset of one episode, and returns
  // its ticket. A decision may wait for the sink, so it must be quick and must never block.
  using Sink = std::function<RecordingTicket(Dataset)>;

  EpisodeRecorder(std::shared_ptr<const ServedPolicy> served, Sink sink);

  // Cuts off the running episode and passes it to the sink.
  ~EpisodeRecorder();
  EpisodeRecorder(const EpisodeRecorder&) = delete;
  EpisodeRecorder& operator=(const EpisodeRecorder&) = delete;

  // Records the answer that `session` has just given, its last_answer. `reward` was earned by the
  // action before it. Ignores decisions until the first step 0.
  void OnDecision(const Session& session, absl::Span<const float> observation, double reward);

  // Records that `executed` was executed in the place of the last answered action.
  void OnExecuted(const Action& executed);

  // Cuts off the running episode, because steps of it are missing.
  void OnGap() { CutOff(); }

  // Ends the running episode. `reward` and `observation` are the results of the last action; if
  // `observation` is empty, NaN is recorded in its place. An episode that has not terminated is
  // recorded as truncated.
  void OnEnd(double reward, absl::Span<const float> observation, bool terminated, bool truncated);

  // Returns where the last episode that has ended is now.
  RecordingState last_state() const {
    return last_ == nullptr ? RecordingState::kNotRecorded : last_->load();
  }

 private:
  void Start(const Session& session);
  void PassToSink();

  // Ends the running episode as truncated, without its last action, whose reward is not known.
  void CutOff();

  const std::shared_ptr<const ServedPolicy> served_;
  const Sink sink_;
  std::optional<Dataset> running_;  // of one episode; absent: none is being recorded
  RecordingTicket last_;            // of the last episode that has ended; null: it was not recorded
};

}  // namespace spikeserve

#endif  // CORE_SESSION_EPISODE_RECORDER_H_
