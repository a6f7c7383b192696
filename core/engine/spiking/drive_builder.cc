#include "core/engine/spiking/drive_builder.h"

#include <cstddef>
#include <cstdint>

#include "core/engine/spiking/kernels/event_kernels.h"
#include "core/engine/spiking/kernels/lif_kernels.h"
#include "core/engine/spiking/packed/packed_linear.h"
#include "core/engine/spiking/packed_integers.h"

namespace spikeserve {
namespace {

// Returns the row of a phase generator as currents. `neurons` is the number of coder inputs.
const float* PhaseRow(const PackedLinear& linear, int neurons, int generator) {
  return linear.row(neurons + generator);
}
const int16_t* PhaseRow(const PackedIntegerPopulation& population, int, int generator) {
  return population.phase_row(generator);
}

}  // namespace

template <class Current>
template <class Population>
const kernels::Drive<Current>& DriveBuilder<Current>::Build(const SpikeInput& input,
                                                            const Population& population, int width,
                                                            const PhaseSpikes* phase) {
  SumGroups(input, population, width);
  const int ticks = input.ticks();
  drive_.ticks = ticks;
  drive_.offsets.assign(ticks + 1, 0);
  // One more than the terms that can fire, because the loop below also writes groups that do not
  // fire, and then overwrites them.
  const size_t terms =
      ticks * afferents_.size() + (phase == nullptr ? 0 : phase->generators.size()) + 1;
  if (drive_.terms.size() < terms) drive_.terms.resize(terms);
  const Current** term = drive_.terms.data();
  for (int tick = 1; tick <= ticks; ++tick) {
    for (Afferent& afferent : afferents_) {
      const bool fires = afferent.next == tick;
      *term = afferent.sum;
      term += fires;  // branch-free, because the branch would be unpredictable
      afferent.next += fires ? afferent.period : 0;
    }
    if (phase != nullptr) {
      for (int k = phase->offsets[tick - 1]; k < phase->offsets[tick]; ++k) {
        *term++ = PhaseRow(population, input.neurons(), phase->generators[k]);
      }
    }
    drive_.offsets[tick] = static_cast<int>(term - drive_.terms.data());
  }
  return drive_;
}

template <class Current>
template <class Population>
void DriveBuilder<Current>::SumGroups(const SpikeInput& input, const Population& population,
                                      int width) {
  const size_t groups = input.groups().size();
  if (sums_.size() < groups * width) sums_.resize(groups * width);
  afferents_.clear();
  for (const SpikeGroup& group : input.groups()) {
    Current* const sum = sums_.data() + afferents_.size() * width;
    afferents_.push_back(
        {.sum = kernels::SumRows(population, input.members(group), group.count, width, sum),
         .next = group.period,
         .period = group.period});
  }
}

template const kernels::Drive<float>& DriveBuilder<float>::Build(const SpikeInput&,
                                                                 const PackedLinear&, int,
                                                                 const PhaseSpikes*);
template const kernels::Drive<int16_t>& DriveBuilder<int16_t>::Build(const SpikeInput&,
                                                                     const PackedIntegerPopulation&,
                                                                     int, const PhaseSpikes*);

}  // namespace spikeserve
