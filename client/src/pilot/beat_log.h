// The beats of the robot that the server may not have. Nothing here waits.
//
// Beats are numbered from 0, over all episodes of the pilot, and the last ones are kept in a ring:
// their observations, their executed actions, and for a longer time their rewards. A history begins
// one beat before the one that the server expects, with what was executed there, or the server's
// context starts behind a gap. So nothing is lost and nothing is counted twice, whatever the link
// does. The memory is reserved once, and touched as it is needed.
//
// An episode goes through these states, and never back:
//
//   running    beats are added at the robot
//   ended      the robot has ended it; the server misses beats, or an older episode's end
//   complete   the server has acknowledged every beat; EndEpisode may be called, again and again
//   ending     its end is under way, on the stream; requests are of the episode after it
//   settled    the server has answered the end; the episode leaves the log once the store of the
//              server has the end, too. A server that has lost it gets the episode again
//
// The server's session is at the oldest episode, or at the one after it if the answer to the end of
// the oldest one is under way or lost. So at most one end is under way: the server repeats the
// answer to the last end only.
//
// Not thread-safe.
#ifndef CLIENT_SRC_PILOT_BEAT_LOG_H_
#define CLIENT_SRC_PILOT_BEAT_LOG_H_

#include <cstddef>
#include <cstdint>
#include <deque>
#include <future>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/types/span.h"
#include "client/src/pilot/action_shape.h"
#include "spikeserve/local_policy.h"
#include "spikeserve/remote_session.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve::piloting {

// A beat in the log, until the next call that changes it.
struct BeatView {
  absl::Span<const float> observation;  // empty: the robot had no valid one
  double reward = 0.0;                  // for the action before
  ActionView executed;                  // of the newest beat: what was executed so far, if anything
};

// A beat outside the ring.
struct KeptBeat {
  std::vector<float> observation;
  double reward = 0.0;
  ActionValue executed;
};

// How an episode has ended, and who waits for its summary.
struct Ending {
  EpisodeOutcome outcome;
  std::promise<absl::StatusOr<v1::EndEpisodeResponse>> summary;
  // The last two beats, or one if there is no other, which outlast the ring: EndEpisode needs the
  // last one, and its place in the session needs the one before.
  std::vector<KeptBeat> last;
};

struct RobotEpisode {
  int64_t index = 0;   // in the server's session
  uint64_t first = 0;  // number of its first beat
  uint64_t steps = 0;
  uint64_t lost_steps = 0;  // before the first one, which only a lost session had
  std::optional<Ending> ending = std::nullopt;

  uint64_t past() const { return first + steps; }
};

class BeatLog {
 public:
  // Keeps `kept` beats, at least 2, that the server may miss, and one before them, with
  // `observation_size` numbers each.
  BeatLog(size_t kept, size_t observation_size, const ActionShape& shape);

  // The episode of the robot's next beat, and the one that the server's session is at.
  const RobotEpisode& running() const { return episodes_.back(); }
  const RobotEpisode& oldest() const { return episodes_.front(); }
  // Returns the one that the next request is of: the oldest one until its end is under way.
  const RobotEpisode& asked() const { return episodes_[is_ending_ ? 1U : 0U]; }
  // Returns whether the next request is of the running episode.
  bool is_current() const { return episodes_.size() == (is_ending_ ? 2U : 1U); }
  // Returns whether the next request would be, after one that ends the oldest episode.
  bool is_one_behind() const { return !is_ending_ && episodes_.size() == 2 && FitsOne(); }
  bool is_ending() const { return is_ending_; }
  // Returns the episode with an index in the server's session, or null.
  const RobotEpisode* Find(int64_t index) const;
  // Returns whether the server has all beats of the oldest episode, which has ended.
  bool is_complete() const;
  // Returns whether the server has missed so much that its session has to be given up.
  bool is_too_long() const;
  // Returns the number of the next beat.
  uint64_t next() const { return next_; }

  // Adds a beat to the running episode, with an empty `observation` if there is no valid one.
  // `observed_at` is in nanoseconds of RobotNow(), `traceparent` the trace context of the beat.
  // Returns its number.
  uint64_t Add(absl::Span<const float> observation, double reward, int64_t observed_at,
               absl::string_view traceparent = "");
  // Sets what the robot has executed in the last beat. REQUIRES: the running episode has one.
  void SetExecuted(const ActionView& action);
  // Ends the running episode, which has a beat. The next beat begins another one.
  std::future<absl::StatusOr<v1::EndEpisodeResponse>> End(EpisodeOutcome outcome);

  // Returns whether what is known of the beat `number` is kept.
  bool Has(uint64_t number) const { return number >= kept_from() && number < next_; }
  // REQUIRES: Has(number).
  BeatView At(uint64_t number) const;
  // Returns the number of the beat that is the decision `decision` of the server's session.
  uint64_t NumberOf(uint64_t decision) const { return decision + base_; }

  // Fills the request for the newest beat of asked(), with the beats that the server may miss. If
  // there are more of them than fit, or this episode has ended, it asks for no decision and carries
  // the oldest ones.
  void FillRequest(v1::ActRequest* request) const;
  // Returns whether FillRequest carries all of them.
  bool FitsOne() const;
  // Fills the end of the oldest episode, which has ended.
  void FillEnd(v1::EndEpisodeRequest* request) const;
  // Notes that the end of the oldest episode is under way, behind all of its beats, or that it is
  // not any more. REQUIRES: it has ended.
  void BeginEnd() { is_ending_ = true; }
  void AbandonEnd() { is_ending_ = false; }

  // Notes that the server expects step `next_step` of the oldest episode.
  void Acknowledge(int64_t next_step);
  // Notes that the server expects an older decision, which is of `episode` if that is known.
  // Returns false if its beat is not kept.
  bool Rewind(uint64_t decision, std::optional<int64_t> episode);
  // Notes that the end of the oldest episode was answered, and returns its ending. With
  // `is_stored`, keeps the episode until the store has the end.
  Ending Settle(bool is_stored);
  // Notes that the store has so many decisions, and the ends of so many episodes. A server of an
  // earlier release does not name the ends; they are in front of the decisions behind them.
  void ForgetDurable(uint64_t decisions, int64_t episodes);
  // Moves to a new session, whose first episode has the rewards of the running one, and its beats
  // as far as they are kept; or begins with the next beat, if the server has refused them. Returns
  // the ends of the episodes that the old one had not ended.
  std::vector<Ending> BeginAgain(bool keeps_beats = true);

  // The most beats of one history that the server appends with their observations.
  void set_history_limit(int64_t limit) { history_limit_ = static_cast<uint64_t>(limit); }
  // Returns the number of beats whose observations were not kept until the server had them.
  uint64_t dropped() const { return dropped_; }
  uint64_t lost_episodes() const { return lost_episodes_; }

 private:
  uint64_t kept_from() const;
  uint64_t kept_from(const RobotEpisode& episode) const;  // with its ending
  uint64_t rewards_from() const;
  size_t SlotOf(uint64_t number) const { return number % kept_; }
  double RewardOf(uint64_t number) const { return rewards_[number % reward_slots_]; }
  // Returns the most beats of one history.
  uint64_t most() const;
  // Returns the number of the first beat in the next request's history, and that behind its last.
  uint64_t HistoryBegin() const;
  uint64_t HistoryPast() const;
  BeatView BeatOf(const RobotEpisode& episode, uint64_t number) const;

  const size_t kept_;
  const size_t reward_slots_;
  const size_t observation_size_;
  const ActionShape shape_;
  const std::unique_ptr<float[]> observations_;  // [kept, observation_size]
  const std::unique_ptr<float[]> continuous_;    // [kept, shape.size()]: executed actions
  const std::unique_ptr<int64_t[]> discrete_;    // [kept]: executed actions
  const std::unique_ptr<double[]> rewards_;      // [reward_slots]
  std::vector<bool> is_blind_;                   // [kept]: no valid observation
  int64_t observed_at_ = 0;                      // of the last beat
  std::string traceparent_;                      // of the last beat
  std::deque<RobotEpisode> settled_;             // whose ends the store may lack
  std::deque<RobotEpisode> episodes_;            // the last one is running
  uint64_t next_ = 0;                            // number of the next beat
  uint64_t base_ = 0;                            // number of the first beat of the server's session
  uint64_t acknowledged_ = 0;                    // number of the beat that the server expects next
  bool is_ending_ = false;                       // the end of the oldest episode is under way
  uint64_t history_limit_ = 0;
  uint64_t dropped_ = 0;
  uint64_t lost_episodes_ = 0;
};

}  // namespace spikeserve::piloting

#endif  // CLIENT_SRC_PILOT_BEAT_LOG_H_
