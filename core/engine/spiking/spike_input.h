// The spikes that flow into a population over the ticks of one token, and the currents they make.
//
// A rate coder's neuron is its period n: it fires at n, 2n, 3n, ... So the rows of all neurons of
// one period are summed once, and at tick t the current is the bias, plus that sum for each period
// dividing t, ascending, plus the rows of the phase spikes at t by head. Bernoulli spikes have no
// period: each tick is summed on its own. Not thread-safe.
#ifndef CORE_ENGINE_SPIKING_SPIKE_INPUT_H_
#define CORE_ENGINE_SPIKING_SPIKE_INPUT_H_

#include <cstdint>
#include <vector>

#include "absl/types/span.h"
#include "core/engine/spiking/kernels/lif_kernels.h"
#include "core/engine/spiking/packed_weights.h"
#include "core/model/policy.h"
#include "core/neuron/coder.h"
#include "core/neuron/period_table.h"

namespace spikeserve {

// The phase generators of one timestep (eq. 4.4), shared by its tokens and by all layers.
struct PhaseSpikes {
  std::vector<int32_t> generators;  // those that fire, by tick, ascending inside a tick
  std::vector<int32_t> offsets;     // [T + 1]: where a tick starts in `generators`

  // Empty ticks in modes without phase spikes.
  void Set(const Policy& policy, int64_t timestep);
};

class SpikeInput {
 public:
  // Sets the coder spikes of a token vector x [d]. `periods` is the table of the policy's neurons;
  // `key` is used by the Bernoulli coder only.
  void Code(const ModelConfig& config, const PeriodTable& periods, const Coder& coder,
            const float* x, const BernoulliKey& key);

  // All coder spikes.
  uint64_t total() const { return total_; }

  // rates[j] = spikes of neuron j / T; [d].
  void Rates(std::vector<float>* rates) const;

  // The currents into the first `width` lanes of `linear`; `phase` may be null. Valid until the
  // next call on this object.
  const kernels::Drive& DriveOf(const PackedLinear& linear, int width, const PhaseSpikes* phase);

  // Sum over all spikes of the nonzero weights [inputs] that their neuron meets.
  uint64_t Products(absl::Span<const uint32_t> nonzero, const PhaseSpikes* phase) const;

 private:
  // Neurons whose rows are added together: those of one period, or those that fire at one tick.
  struct Group {
    int tick = 0;  // the period, or the tick itself, 1 ... T
    int first = 0;
    int count = 0;
    int spikes = 0;  // of each member, in this group
  };

  void CodePeriods(const PeriodTable& table, const Coder& coder, const float* x);
  void CodeBernoulli(const Coder& coder, const float* x, const BernoulliKey& key);

  int ticks_ = 0;
  int neurons_ = 0;  // d
  bool periodic_ = true;
  uint64_t total_ = 0;
  std::vector<int32_t> members_;  // neurons by group, ascending inside a group
  std::vector<Group> groups_;     // none empty, ascending by tick
  // Of the rate coder:
  std::vector<int32_t> periods_;  // [d]
  std::vector<uint32_t> active_;  // [d / 32] bits: neurons that fire
  std::vector<int> next_;         // [T + 1]: members of each period, then where its next one goes
  // Of the currents:
  struct Afferent {
    const float* sum = nullptr;  // of the group's rows
    int next = 0;                // the tick at which the group fires next
    int period = 0;              // after which it fires again; 0: never
  };
  std::vector<Afferent> afferents_;  // [groups]
  AlignedVector<float> sums_;        // [groups][width]
  kernels::Drive drive_;
};

}  // namespace spikeserve

#endif  // CORE_ENGINE_SPIKING_SPIKE_INPUT_H_
