// Which action a control step gets, by the fallback order of docs/reference/beats.md. Nothing here
// waits, and nothing allocates memory after the constructor.
//
// Not thread-safe.
#pragma once

#include <array>
#include <cstdint>
#include <optional>

#include "core/robot/action_shape.h"
#include "core/robot/counters.h"
#include "core/robot/time.h"

namespace spikeserve::robot {

// A source was left after `steps` steps, and `to` entered.
struct SourceChange {
  Source from;
  Source to;
  uint64_t steps;
};

class FallbackOrder {
 public:
  // `neutral` belongs to the action space of `shape`. A last action is held for `hold_steps`, while
  // its observation is not older than `oldest_held`, and the way from it to the neutral action
  // takes `ramp_steps`. `now`, of the robot's clock as all times here, stands for the observation
  // of safe actions before the first one that an action was chosen for.
  FallbackOrder(ActionShape shape, const ActionValue& neutral, int hold_steps, Time oldest_held,
                int ramp_steps, Time now);

  const ActionShape& shape() const { return shape_; }
  const ActionValue& neutral() const { return neutral_; }
  // The action of the last step, its source, and when its observation was made.
  const ActionValue& action() const { return last_; }
  Source source() const { return *source_; }
  ChooserView chooser() const;
  Time observed_at() const { return observed_at_; }

  // Forgets the actions of the episode before.
  void BeginEpisode();
  // Notes that the robot has executed another action than that of the last step.
  void SetExecuted(const ActionView& action) { last_.Assign(action); }

  // Each step calls those below in this order, until one of them returns true or has no result.

  // Takes the answer, which `chooser` has chosen, for an observation that was made at
  // `observed_at`.
  void TakeFresh(const ActionView& action, Time observed_at,
                 const ChooserView& chooser = {.kind = Chooser::kPolicy});
  // Takes the last action again, if it may be held.
  bool Hold(Time now);
  // Ends the holding of the last action until the next fresh one.
  void Release() { can_hold_ = false; }
  // Takes the decision of the engine on the robot.
  void TakeLocal(const ActionView& action, Time observed_at);
  // Goes one step on the way to the neutral action. Returns false at its end.
  bool Ramp();
  // Takes the neutral action, or the one of the robot's own function.
  void TakeSafe(const ActionView& action);

  // Returns how often each source was entered, by Source.
  const BySource& entries() const { return entries_; }
  // Returns the oldest change that is worth a line in a log, once. Only the last ones are kept.
  // Changes between fresh and held are none: they happen on every link.
  std::optional<SourceChange> TakeChange();
  bool has_change() const { return noted_ > taken_; }

 private:
  // Notes a step from `source`.
  void Enter(Source source);

  const ActionShape shape_;
  const ActionValue neutral_;
  const int hold_steps_;
  const Time oldest_held_;
  const int ramp_steps_;
  ActionValue last_;
  ChooserValue fresh_;  // who chose the last fresh action
  Time observed_at_;
  int held_ = 0;  // steps since the last fresh action that held it
  bool can_hold_ = false;
  ActionValue ramp_from_;
  int ramped_ = 0;                // steps of the ramp
  std::optional<Source> source_;  // absent: before the first step
  uint64_t source_steps_ = 0;
  BySource entries_ = {};
  std::array<SourceChange, 16> changes_ = {};
  uint64_t noted_ = 0;
  uint64_t taken_ = 0;
};

}  // namespace spikeserve::robot
