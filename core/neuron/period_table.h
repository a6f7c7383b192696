// Looks up the period of a LIF neuron under a constant current, without simulating the neuron.
//
// The membrane after n ticks never decreases when the current increases: in float32, multiplication
// by a factor that is not negative and addition are monotone, rounding included. A neuron therefore
// fires within n ticks if and only if its current reaches a threshold. The constructor finds the
// threshold of each n by bisection over the floats; a lookup counts the thresholds that the current
// reaches. The result equals the simulated period bit for bit:
//
//   const PeriodTable table(lif, ticks);
//   table.Period(0.3f);  // equals lif.Period(0.3f, ticks)
//
// Immutable and thread-safe.
#pragma once

#include <bit>
#include <cstdint>
#include <vector>

#include "core/contract/dcheck.h"
#include "core/neuron/lif.h"

namespace spikeserve {

class PeriodTable {
 public:
  // REQUIRES: lif.decay in [0, 1], lif.threshold > 0.
  PeriodTable(const Lif& lif, int ticks) {
    SPIKESERVE_DCHECK(lif.decay >= 0.0f && lif.decay <= 1.0f);
    SPIKESERVE_DCHECK_GT(lif.threshold, 0.0f);
    for (int n = 1; n <= ticks; ++n) thresholds_.push_back(SmallestCurrent(lif, n));
  }

  // Returns the same value as Lif::Period(current, ticks): 0 if the current is NaN, which reaches
  // no threshold.
  int Period(float current) const {
    const auto ticks = static_cast<int>(thresholds_.size());
    int period = ticks + 1;
    for (const float threshold : thresholds_) period -= current >= threshold;
    return period > ticks ? 0 : period;
  }

  // Returns the thresholds, [ticks]. Element n - 1 is the smallest current that fires within n
  // ticks, so the elements never increase with n.
  const std::vector<float>& thresholds() const { return thresholds_; }

 private:
  // Returns the smallest current that fires within `ticks` ticks. Bisects over bit patterns,
  // because positive floats are ordered like their bits.
  static float SmallestCurrent(const Lif& lif, int ticks) {
    uint32_t silent = 0;                                   // a current of zero never fires
    auto firing = std::bit_cast<uint32_t>(lif.threshold);  // this current fires at tick 1
    while (firing - silent > 1) {
      const uint32_t middle = silent + (firing - silent) / 2;
      (lif.Period(std::bit_cast<float>(middle), ticks) > 0 ? firing : silent) = middle;
    }
    return std::bit_cast<float>(firing);
  }

  std::vector<float> thresholds_;
};

}  // namespace spikeserve
