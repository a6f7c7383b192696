// Adds up the currents that the input spikes of a token cause in a population.
//
//   DriveBuilder<float> builder;
//   const kernels::Drive<float>& drive = builder.Build(input, linear, linear.width, &phase);
//
// A rate coder's neuron of period n fires at the ticks n, 2n, 3n, ... The rows of all neurons of
// one period are therefore added up once per token. The current at tick t is the bias, plus this
// sum for each period that divides t, ascending, plus the rows of the phase spikes at t by head.
// Not thread-safe.
#pragma once

#include <vector>

#include "core/engine/spiking/kernels/drive.h"
#include "core/engine/spiking/packed/aligned_vector.h"
#include "core/engine/spiking/spike_input.h"

namespace spikeserve {

// `Current` is float or int16_t; `Population` below is the packed population with such currents.
template <class Current>
class DriveBuilder {
 public:
  // Returns the currents into the first `width` lanes of `population`; `phase` may be null. The
  // result is valid until the next call on this object, and refers to `population`.
  template <class Population>
  const kernels::Drive<Current>& Build(const SpikeInput& input, const Population& population,
                                       int width, const PhaseSpikes* phase);

 private:
  // The afferent of a group:
  struct Afferent {
    const Current* sum = nullptr;  // of the rows of the group
    int next = 0;                  // tick at which the group fires next
    int period = 0;                // ticks until it fires again
  };

  template <class Population>
  void SumGroups(const SpikeInput& input, const Population& population, int width);

  std::vector<Afferent> afferents_;  // [groups]
  AlignedVector<Current> sums_;      // [groups][width]
  kernels::Drive<Current> drive_;
};

}  // namespace spikeserve
