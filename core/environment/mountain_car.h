// MountainCar-v0: drive an underpowered car out of a valley by pushing it to the left (action 0),
// coasting (1) or pushing it to the right (2).
//
// A. W. Moore, "Efficient Memory-based Learning for Robot Control", PhD thesis, Cambridge, 1990, in
// Gymnasium's form.
// - State and observation [2]: position in [-1.2, 0.6], velocity in [-0.07, 0.07], in the task's
//   own units.
// - Reward: -1 per step.
// - Termination: the position is at least 0.5 and the velocity at least 0. Time limit: 200 steps.
#ifndef CORE_ENVIRONMENT_MOUNTAIN_CAR_H_
#define CORE_ENVIRONMENT_MOUNTAIN_CAR_H_

#include <vector>

#include "absl/strings/string_view.h"
#include "core/environment/classic_control.h"

namespace spikeserve {

// Physical constants, as the change of velocity per step; the defaults are Gymnasium's.
struct MountainCarParameters {
  double force = 0.001;
  double gravity = 0.0025;
};

class MountainCar final : public ClassicControl {
 public:
  static constexpr absl::string_view kId = "MountainCar-v0";

  explicit MountainCar(const MountainCarParameters& parameters = {});

  double Advance(const Action& action, absl::Span<double> state) const override;
  bool IsTerminal(absl::Span<const double> state) const override;

 private:
  std::vector<double> DrawInitialState(NumpyRandom& random) const override;
  std::vector<float> Observe(absl::Span<const double> state) const override;

  MountainCarParameters parameters_;
};

}  // namespace spikeserve

#endif  // CORE_ENVIRONMENT_MOUNTAIN_CAR_H_
