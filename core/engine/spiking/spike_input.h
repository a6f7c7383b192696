// Computes the spikes that flow into a population over the ticks of one token.
//
//   SpikeInput input;
//   input.Code(config, periods, coder, x);
//   const kernels::Drive<float>& drive = builder.Build(input, linear, linear.width, &phase);
//
// Not thread-safe.
#pragma once

#include <cstdint>
#include <vector>

#include "absl/types/span.h"
#include "core/engine/spiking/packed/packed_fixed_point.h"
#include "core/model/policy.h"
#include "core/neuron/period_table.h"
#include "core/neuron/phase.h"

namespace spikeserve {

// The phase spikes of one timestep (eq. 4.4), shared by its tokens and by all layers.
struct PhaseSpikes {
  std::vector<int32_t> generators;  // generators that fire, by tick, ascending inside a tick
  std::vector<int32_t> offsets;     // [T + 1]: index in `generators` at which a tick starts
  std::vector<int32_t> firing;      // generators that fire at some tick; in integer arithmetic only

  // Computes the phase spikes of `timestep`. In modes without phase spikes, all ticks are empty.
  void Set(const Policy& policy, int64_t timestep);

  // As above in integer arithmetic. `phases` are the generators of the policy.
  void Set(const std::vector<IntegerPhase>& phases, int ticks, int64_t timestep);
};

// The neurons of one period, whose rows are added together. At least one.
struct SpikeGroup {
  int period = 0;  // 1 ... T
  int first = 0;   // index of the first member in the input's list
  int count = 0;
  int spikes = 0;  // of each member in this group
};

// The coder spikes of one token.
class SpikeInput {
 public:
  // Computes the coder spikes of a token vector x [d]. `periods` is the table of the policy's
  // neurons.
  void Code(const ModelConfig& config, const PeriodTable& periods, const Coder& coder,
            const float* x);

  // The same in integer arithmetic; `x` is [coder.width].
  void Code(const PackedPeriodCoder& coder, const int16_t* x);

  // Returns the number of coder spikes.
  uint64_t total() const { return total_; }

  // Sets rates[j] to the spike count of neuron j divided by T; [d].
  void Rates(std::vector<float>* rates) const;

  int ticks() const { return ticks_; }
  int neurons() const { return neurons_; }                           // d
  const std::vector<SpikeGroup>& groups() const { return groups_; }  // ascending by period
  // Returns the neurons of a group, ascending, [count].
  const int32_t* members(const SpikeGroup& group) const { return members_.data() + group.first; }

  // Returns the number of nonzero weights of the neurons that fire; `nonzero` is as below.
  uint64_t Synapses(absl::Span<const uint32_t> nonzero) const;

  // Returns the number of products of a spike and a nonzero weight, where `nonzero` [inputs] is the
  // number of nonzero weights of each input; `phase` may be null.
  uint64_t Products(absl::Span<const uint32_t> nonzero, const PhaseSpikes* phase) const;

  // Returns the number of nonzero weights of all inputs that fire, however often.
  uint64_t Rows(absl::Span<const uint32_t> nonzero, const PhaseSpikes* phase) const;

 private:
  uint64_t SynapsesOf(const SpikeGroup& group, absl::Span<const uint32_t> nonzero) const;
  // Sets the groups from periods_ and active_.
  void GroupByPeriod();

  int ticks_ = 0;
  int neurons_ = 0;  // d
  uint64_t total_ = 0;
  std::vector<int32_t> members_;  // neurons by group, ascending inside a group
  std::vector<SpikeGroup> groups_;
  std::vector<int32_t> periods_;  // [d]
  std::vector<uint32_t> active_;  // [ceil(d / 32)] words: bit j is set if neuron j fires
  std::vector<int> next_;         // [T + 1]: members of each period, then next index to write
};

}  // namespace spikeserve
