// Which action a beat gets: the fallback order in PilotOptions. Nothing here waits, and
// nothing allocates memory after the constructor.
//
// Not thread-safe.
#ifndef CLIENT_SRC_PILOT_FALLBACK_ORDER_H_
#define CLIENT_SRC_PILOT_FALLBACK_ORDER_H_

#include <array>
#include <cstdint>
#include <optional>

#include "absl/time/time.h"
#include "client/src/pilot/action_shape.h"
#include "spikeserve/local_policy.h"
#include "spikeserve/pilot_stats.h"

namespace spikeserve::piloting {

// A source was left after `beats` beats, and `to` entered.
struct SourceChange {
  ActionSource from;
  ActionSource to;
  uint64_t beats;
};

class FallbackOrder {
 public:
  // `neutral` belongs to the action space of `shape`. A last action is held for `hold_beats`, while
  // its observation is not older than `oldest_held`, and the way from it to the neutral action
  // takes `ramp_beats`. `now`, of RobotNow() as all times here, stands for the observation of safe
  // actions before the first one that an action was chosen for.
  FallbackOrder(ActionShape shape, const ActionValue& neutral, int hold_beats,
                absl::Duration oldest_held, int ramp_beats, absl::Duration now);

  const ActionShape& shape() const { return shape_; }
  const ActionValue& neutral() const { return neutral_; }
  // The action of the last beat, its source, and when its observation was made.
  const ActionValue& action() const { return last_; }
  ActionSource source() const { return *source_; }
  absl::Duration observed_at() const { return observed_at_; }

  // Forgets the actions of the episode before.
  void BeginEpisode();
  // Notes that the robot has executed another action than that of the last beat.
  void SetExecuted(const ActionView& action) { last_.Assign(action); }

  // Each beat calls those below in this order, until one of them returns true or has no result.

  // Takes the answer for an observation that was made at `observed_at`.
  void TakeFresh(const ActionView& action, absl::Duration observed_at);
  // Takes the last action again, if it may be held.
  bool Hold(absl::Duration now);
  // Ends the holding of the last action until the next fresh one.
  void Release() { can_hold_ = false; }
  // Takes the decision of the engine on the robot.
  void TakeLocal(const ActionView& action, absl::Duration observed_at);
  // Goes one beat on the way to the neutral action. Returns false at its end.
  bool Ramp();
  // Takes the neutral action, or the one of the robot's own function.
  void TakeSafe(const ActionView& action);

  // Returns how often each source was entered, by ActionSource.
  const PilotStats::BySource& entries() const { return entries_; }
  // Returns the oldest change that is worth a line in a log, once. Only the last ones are kept.
  // Changes between fresh and held are none: they happen on every link.
  std::optional<SourceChange> TakeChange();
  bool has_change() const { return noted_ > taken_; }

 private:
  // Notes a beat from `source`.
  void Enter(ActionSource source);

  const ActionShape shape_;
  const ActionValue neutral_;
  const int hold_beats_;
  const absl::Duration oldest_held_;
  const int ramp_beats_;
  ActionValue last_;
  absl::Duration observed_at_;
  int held_ = 0;  // beats since the last fresh action that held it
  bool can_hold_ = false;
  ActionValue ramp_from_;
  int ramped_ = 0;                      // beats of the ramp
  std::optional<ActionSource> source_;  // absent: before the first beat
  uint64_t source_beats_ = 0;
  PilotStats::BySource entries_ = {};
  std::array<SourceChange, 16> changes_ = {};
  uint64_t noted_ = 0;
  uint64_t taken_ = 0;
};

}  // namespace spikeserve::piloting

#endif  // CLIENT_SRC_PILOT_FALLBACK_ORDER_H_
