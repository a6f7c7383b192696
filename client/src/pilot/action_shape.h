// The actions of a policy as a pilot stores them: of one size, so that nothing is allocated later.
#ifndef CLIENT_SRC_PILOT_ACTION_SHAPE_H_
#define CLIENT_SRC_PILOT_ACTION_SHAPE_H_

#include <cstddef>
#include <cstdint>
#include <vector>

#include "absl/types/span.h"
#include "spikeserve/local_policy.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve::piloting {

// An action that has its own memory.
struct ActionValue {
  int64_t discrete = 0;
  std::vector<float> continuous;

  ActionView view() const { return {discrete, continuous}; }
  // Copies `action`. Allocates nothing if it is as long as the one before.
  void Assign(const ActionView& action) {
    discrete = action.discrete;
    continuous.assign(action.continuous.begin(), action.continuous.end());
  }
};

// An action space. Immutable.
class ActionShape {
 public:
  explicit ActionShape(const v1::ActionSpace& space);

  bool is_box() const { return n_ == 0; }
  // Returns the number of elements of a Box; 0 for a Discrete space.
  size_t size() const { return low_.size(); }

  // Copies `action` to `fitted`, its elements limited to their bounds. Returns false if it has
  // another size or a number that is not finite, or is no index of the space.
  bool Fit(const ActionView& action, ActionValue* fitted) const;

 private:
  int64_t n_ = 0;
  std::vector<float> low_;
  std::vector<float> high_;
};

// Returns a view of `action`, which is valid as long as that is not changed.
ActionView ViewOf(const v1::Action& action);

// Writes `action` to a message.
void ToProto(const ActionView& action, const ActionShape& shape, v1::Action* message);

}  // namespace spikeserve::piloting

#endif  // CLIENT_SRC_PILOT_ACTION_SHAPE_H_
