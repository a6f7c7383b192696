// Records the episodes of one session while they are played.
//
// Not thread-safe: protected by the same lock as its session.
#pragma once

#include <atomic>
#include <functional>
#include <memory>
#include <optional>

#include "core/agent/served_policy.h"
#include "core/agent/session_listener.h"
#include "core/dataset/dataset.h"
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
class EpisodeRecorder final : public SessionListener {
 public:
  // A longer episode is cut off after this number of steps, to limit the memory that one client can
  // occupy.
  static constexpr int kLongestEpisode = 100'000;

  // Receives every episode of at least one complete step, as a dataset of one episode, and returns
  // its ticket. A decision may wait for the sink, so it must be quick and must never block.
  using Sink = std::function<RecordingTicket(Dataset)>;

  EpisodeRecorder(std::shared_ptr<const ServedPolicy> served, Sink sink);

  // Cuts off the running episode and passes it to the sink.
  ~EpisodeRecorder() override;
  EpisodeRecorder(const EpisodeRecorder&) = delete;
  EpisodeRecorder& operator=(const EpisodeRecorder&) = delete;

  // Ignores decisions until the first step 0.
  void OnDecision(const Session& session, const DecisionInputs& inputs) override;
  void OnExecuted(const Action& executed) override;
  // Cuts off the running episode, because steps of it are missing.
  void OnGap() override { CutOff(); }
  // Records NaN in the place of a last observation that is not known. An episode that has not
  // terminated is recorded as truncated.
  bool OnEpisodeEnd(const Session& session,
                    const std::shared_ptr<FleetContribution>& contribution) override;

  // Ends the running episode without its last action, whose reward is not known: as truncated, or
  // as terminated by the observation of that action.
  void CutOff(bool terminated = false);

  // Returns where the last episode that has ended is now.
  RecordingState last_state() const {
    return last_ == nullptr ? RecordingState::kNotRecorded : last_->load();
  }

 private:
  void Start(const Session& session);
  void PassToSink();

  const std::shared_ptr<const ServedPolicy> served_;
  const Sink sink_;
  std::optional<Dataset> running_;  // of one episode; absent: none is being recorded
  RecordingTicket last_;            // of the last episode that has ended; null: it was not recorded
};

}  // namespace spikeserve
