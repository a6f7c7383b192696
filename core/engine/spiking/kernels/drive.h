// Defines the input currents of a population.
#pragma once

#include <vector>

namespace spikeserve::kernels {

// The input currents of a population, float or int16_t. At tick t (0 ... ticks-1), the current is
// the bias plus the vectors terms[offsets[t]] ... terms[offsets[t+1]-1], added in that order.
template <class Current>
struct Drive {
  int ticks = 0;
  std::vector<const Current*> terms;
  std::vector<int> offsets;  // [ticks + 1]
};

}  // namespace spikeserve::kernels
