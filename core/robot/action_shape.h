// The actions of a policy as a robot stores them: of one size, so that nothing is allocated later;
// and who chose them.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <string_view>
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

// Who chose an executed action. The numbers are those of v1::ActionSource::Kind, which says what
// each one is.
enum class Chooser : uint8_t {
  kUnknown,
  kPolicy,
  kOperator,
  kSafetyLayer,
  kHeld,
  kLocal,
  kSafe,
  kHold
};

inline constexpr size_t kLongestOperatorId = 128;  // bytes

struct ChooserView {
  Chooser kind = Chooser::kUnknown;
  std::string_view operator_id = {};  // kOperator only
};

// Has its own memory.
struct ChooserValue {
  Chooser kind = Chooser::kUnknown;
  std::string operator_id;

  ChooserView view() const { return {kind, operator_id}; }
  // Copies `chooser`. Allocates nothing if a name of this length was there before.
  void Assign(const ChooserView& chooser) {
    kind = chooser.kind;
    operator_id.assign(chooser.operator_id.data(), chooser.operator_id.size());
  }
};

// Returns whether the wire contract takes the chooser: a known one, and the name of an operator, if
// there is one, in UTF-8 of at most kLongestOperatorId bytes.
bool IsValid(const ChooserView& chooser);
// Returns `chooser`, without what is not valid.
ChooserView Fit(const ChooserView& chooser);

bool IsEqual(const ActionView& a, const ActionView& b);

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
