// The actions of a policy as a robot stores them: of one size, so that nothing is allocated later.
#ifndef CORE_ROBOT_ACTION_SHAPE_H_
#define CORE_ROBOT_ACTION_SHAPE_H_

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

namespace spikeserve::robot {

// An action that somebody else owns: an index of a Discrete space, or one number for each element
// of a Box, in environment units.
struct ActionView {
  int64_t discrete = 0;
  std::span<const float> continuous = {};
};

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
  // A Discrete space of `n` actions, or with 0 a Box with these bounds of its elements.
  ActionShape(int64_t n, std::vector<float> low, std::vector<float> high);

  bool is_box() const { return n_ == 0; }
  // Returns the number of elements of a Box; 0 for a Discrete space.
  size_t size() const { return low_.size(); }

  // Copies `action` to `fitted`, its elements limited to their bounds. Returns false if it has
  // another size or a number that is not finite, or is no index of the space.
  bool Fit(const ActionView& action, ActionValue* fitted) const;

 private:
  int64_t n_;
  std::vector<float> low_;
  std::vector<float> high_;
};

}  // namespace spikeserve::robot

#endif  // CORE_ROBOT_ACTION_SHAPE_H_
