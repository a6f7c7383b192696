// State shared by the robot's thread and the pilot's background thread.
#ifndef CLIENT_SRC_PILOT_SHARED_STATE_H_
#define CLIENT_SRC_PILOT_SHARED_STATE_H_

#include <array>
#include <condition_variable>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>

#include "absl/base/thread_annotations.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "client/src/pilot/action_shape.h"
#include "client/src/pilot/background_thread.h"
#include "client/src/pilot/beat_log.h"
#include "client/src/pilot/counters.h"
#include "client/src/pilot/fallback_order.h"
#include "client/src/pilot/sight.h"
#include "client/src/steady_time.h"

namespace spikeserve::piloting {

// A decision for the beat `number`.
struct Decision {
  bool is_there = false;
  uint64_t number = 0;
  ActionValue action = {};
  absl::Duration observed_at = absl::ZeroDuration();  // of RobotNow()
  // The action is the neutral one, because the observations look miswired.
  bool is_miswired = false;
};

// A request for the newest beat of an episode, or one that ends it.
struct SentRequest {
  int64_t episode = 0;  // index
  uint64_t number = 0;
  absl::Duration sent;  // of SteadyNow()
  bool ends = false;    // it ends the episode
  bool asks = true;     // for a decision
};

// The requests that have no reply, oldest first, in a ring.
class UnderWay {
 public:
  bool empty() const { return size_ == 0; }
  size_t size() const { return size_; }
  const SentRequest& front() const { return (*this)[0]; }
  const SentRequest& operator[](size_t i) const { return ring_[(begin_ + i) % ring_.size()]; }
  // REQUIRES: size() < 64.
  void Push(const SentRequest& request) { ring_[(begin_ + size_++) % ring_.size()] = request; }
  SentRequest Pop() {
    const SentRequest request = front();
    begin_ = (begin_ + 1) % ring_.size();
    --size_;
    return request;
  }
  void Clear() { size_ = 0; }

 private:
  std::array<SentRequest, 64> ring_;
  size_t begin_ = 0;
  size_t size_ = 0;
};

// What was not valid in a beat; each kind is logged once.
enum class Replaced { kObservation, kReward, kExecuted, kFallback };
inline constexpr size_t kReplaced = 4;

struct SharedState {
  // The arguments are those of BeatLog and FallbackOrder.
  SharedState(size_t kept, size_t observation_size, const ActionShape& shape,
              const ActionValue& neutral, int hold_beats, absl::Duration oldest_held,
              int ramp_beats)
      : log(kept, observation_size, shape),
        fallback(shape, neutral, hold_beats, oldest_held, ramp_beats, RobotNow()),
        counters(SteadyNow()) {}

  mutable absl::Mutex mutex;
  // Notified when a decision has arrived. A CondVar of Abseil would measure its timeouts by the
  // time of day.
  std::condition_variable_any has_decision;
  // Wakes the background thread. Set by the link before any other thread knows of this.
  BackgroundThread* background = nullptr;
  BackgroundThread::Worker* worker = nullptr;
  void NotifyWork() { background->Wake(worker); }

  BeatLog log ABSL_GUARDED_BY(mutex);
  FallbackOrder fallback ABSL_GUARDED_BY(mutex);
  Counters counters ABSL_GUARDED_BY(mutex);
  std::array<bool, kReplaced> replaced ABSL_GUARDED_BY(mutex) = {};
  Blindness blindness ABSL_GUARDED_BY(mutex);  // why the last invalid observation was not valid

  // The newest decisions of the server and of the engine on the robot.
  Decision answer ABSL_GUARDED_BY(mutex);
  Decision local ABSL_GUARDED_BY(mutex);
  bool has_local ABSL_GUARDED_BY(mutex) = false;  // the engine can decide
  bool shares_head ABSL_GUARDED_BY(mutex) = false;

  std::string session_id ABSL_GUARDED_BY(mutex);
  bool is_connected ABSL_GUARDED_BY(mutex) = false;    // there are a session and a stream
  bool ends_on_stream ABSL_GUARDED_BY(mutex) = false;  // episodes end there, not by EndEpisode
  std::optional<SentRequest> queued ABSL_GUARDED_BY(mutex);  // to be sent by the background thread
  UnderWay under_way ABSL_GUARDED_BY(mutex);
  size_t window ABSL_GUARDED_BY(mutex) = 1;  // most requests under way
  // By SteadyNow(): no requests before, as the server asked.
  absl::Duration paused_until ABSL_GUARDED_BY(mutex) = -absl::InfiniteDuration();
  std::optional<absl::Duration> round_trip ABSL_GUARDED_BY(mutex);  // smoothed
  std::optional<absl::Duration> closes_at ABSL_GUARDED_BY(mutex);   // absent: the pilot is open
};

}  // namespace spikeserve::piloting

#endif  // CLIENT_SRC_PILOT_SHARED_STATE_H_
