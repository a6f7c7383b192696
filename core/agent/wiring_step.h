// Compares how the wiring of the training data and other wirings explain one step of a robot, by
// the policy's WiringModel.
//
// Not thread-safe: the steps of a thread share its scratch memory, so a step is valid until the
// next one is made. The numbers have equal bits on every processor. Symbol: obs number of elements
// of an observation.
#pragma once

#include <cstddef>
#include <vector>

#include "absl/types/span.h"
#include "core/model/policy.h"
#include "core/model/wiring_model.h"
#include "core/session/history.h"
#include "core/session/wiring_state.h"

namespace spikeserve {

// A wiring other than that of the training data.
struct Wiring {
  WiringCause cause = WiringCause::kDelay;
  size_t i = 0, j = 0;  // elements
};

// Returns how many wirings there are of `obs` elements: the pairs, the signs, the units, the delay.
size_t Wirings(size_t obs);
// Returns wiring `number` of them. REQUIRES: number < Wirings(obs).
Wiring WiringOf(size_t number, size_t obs);

class WiringStep {
 public:
  // The step from timestep `t` of `history` to the observation `after` [obs], in environment units.
  // The policy, the history and `after` must outlive the step.
  WiringStep(const Policy& policy, const History& history, size_t t, absl::Span<const float> after);

  // Surprise of the step in the wiring of the training data.
  double surprise() const { return surprise_; }

  struct Fit {
    double surprise;        // of the step
    double spread;          // WiringModel::Spread of its observation
    double standing = 0.0;  // surprise of the step if the robot stood still; of another wiring: 0
  };
  // Returns how the wiring of the training data explains the step.
  Fit ExplainAsTrained() const;
  // Returns how `wiring` explains the step. `trained` is what ExplainAsTrained() returned, which is
  // also the result if the wiring makes no difference to the step, or not enough is known.
  Fit Explain(const Wiring& wiring, const Fit& trained);

  // A unit is plausible only if the element is far from the training data without it.
  bool IsPlausible(const Wiring& wiring) const;

 private:
  // The memory of a thread.
  struct Scratch;
  static Scratch& ThreadScratch();

  Fit ExplainDelay(const Fit& trained) const;

  const WiringModel& model_;
  const absl::Span<const float> before_, after_;
  Scratch& scratch_;
  double surprise_ = 0.0;
  bool has_slopes_ = false;  // for Explain()
};

}  // namespace spikeserve
