// The period of a LIF neuron under a constant current, in closed form.
//
// The membrane after n ticks never falls when the current grows: a product with a factor that is
// not negative and a sum are monotone in float32, rounding included. So "fires within n ticks" is
// "the current reaches a threshold", found once by bisection over the floats, and a period is a
// count of comparisons that equals the simulated one bit for bit.
//
// Immutable; safe to share between threads.
#ifndef CORE_NEURON_PERIOD_TABLE_H_
#define CORE_NEURON_PERIOD_TABLE_H_

#include <bit>
#include <cstdint>
#include <vector>

#include "core/neuron/lif.h"

namespace spikeserve {

class PeriodTable {
 public:
  // REQUIRES: lif.decay in [0, 1], lif.threshold > 0.
  PeriodTable(const Lif& lif, int ticks) {
    for (int n = 1; n <= ticks; ++n) thresholds_.push_back(SmallestCurrent(lif, n));
  }

  // The same as Lif::Period(current, ticks).
  int Period(float current) const {
    int period = 1;
    for (const float threshold : thresholds_) period += current < threshold;
    return period > static_cast<int>(thresholds_.size()) ? 0 : period;
  }

  // thresholds()[n - 1] is the smallest current that fires within n ticks; falls as n grows.
  // [ticks]
  const std::vector<float>& thresholds() const { return thresholds_; }

 private:
  // Positive floats are ordered as their bits are.
  static float SmallestCurrent(const Lif& lif, int ticks) {
    uint32_t silent = 0;                                   // a current of zero never fires
    auto firing = std::bit_cast<uint32_t>(lif.threshold);  // this one fires at once
    while (firing - silent > 1) {
      const uint32_t middle = silent + (firing - silent) / 2;
      (lif.Period(std::bit_cast<float>(middle), ticks) > 0 ? firing : silent) = middle;
    }
    return std::bit_cast<float>(firing);
  }

  std::vector<float> thresholds_;
};

}  // namespace spikeserve

#endif  // CORE_NEURON_PERIOD_TABLE_H_
