// Computes the spikes that flow into a population over the ticks of one token, and the currents
// that they cause.
//
//   SpikeInput input;
//   input.Code(config, periods, coder, x, key);
//   const kernels::Drive& drive = input.DriveOf(linear, linear.width, &phase);
//
// A rate coder's neuron of period n fires at the ticks n, 2n, 3n, ... The rows of all neurons of
// one period are therefore added up once per token. The current at tick t is the bias, plus this
// sum for each period that divides t, ascending, plus the rows of the phase spikes at t by head.
// Bernoulli spikes have no period, so every tick is added up separately. Not thread-safe.
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

// The phase spikes of one timestep (eq. 4.4), shared by its tokens and by all layers.
struct PhaseSpikes {
  std::vector<int32_t> generators;  // generators that fire, by tick, ascending inside a tick
  std::vector<int32_t> offsets;     // [T + 1]: index in `generators` at which a tick starts

  // Computes the phase spikes of `timestep`. In modes without phase spikes, all ticks are empty.
  void Set(const Policy& policy, int64_t timestep);
};

// The coder spikes of one token.
class SpikeInput {
 public:
  // Computes the coder spikes of a token vector x [d]. `periods` is the table of the policy's
  // neurons; only the Bernoulli coder uses `key`.
  void Code(const ModelConfig& config, const PeriodTable& periods, const Coder& coder,
            const float* x, const BernoulliKey& key);

  // Returns the number of coder spikes.
  uint64_t total() const { return total_; }

  // Sets rates[j] to the spike count of neuron j divided by T; [d].
  void Rates(std::vector<float>* rates) const;

  // Returns the currents into the first `width` lanes of `linear`; `phase` may be null. The result
  // is valid until the next call on this object.
  const kernels::Drive& DriveOf(const PackedLinear& linear, int width, const PhaseSpikes* phase);

  // Returns the number of products of a spike and a nonzero weight, where `nonzero` [inputs] is the
  // number of nonzero weights of each input; `phase` may be null.
  uint64_t Products(absl::Span<const uint32_t> nonzero, const PhaseSpikes* phase) const;

 private:
  // Neurons whose rows are added together: those of one period (rate coder), or those that fire at
  // one tick (Bernoulli coder).
  struct Group {
    int tick = 0;   // the period, or the tick, 1 ... T
    int first = 0;  // index in members_
    int count = 0;
    int spikes = 0;  // of each member in this group
  };

  void CodePeriods(const PeriodTable& table, const Coder& coder, const float* x);
  void CodeBernoulli(const Coder& coder, const float* x, const BernoulliKey& key);

  int ticks_ = 0;
  int neurons_ = 0;  // d
  bool periodic_ = true;
  uint64_t total_ = 0;
  std::vector<int32_t> members_;  // neurons by group, ascending inside a group
  std::vector<Group> groups_;     // not empty, ascending by tick
  // Used by the rate coder:
  std::vector<int32_t> periods_;  // [d]
  std::vector<uint32_t> active_;  // [ceil(d / 32)] words: bit j is set if neuron j fires
  std::vector<int> next_;         // [T + 1]: members of each period, then next index to write
  // Used to compute the currents. The afferent of a group:
  struct Afferent {
    const float* sum = nullptr;  // of the rows of the group
    int next = 0;                // tick at which the group fires next
    int period = 0;              // ticks until it fires again; 0: never
  };
  std::vector<Afferent> afferents_;  // [groups]
  AlignedVector<float> sums_;        // [groups][width]
  kernels::Drive drive_;
};

}  // namespace spikeserve

#endif  // CORE_ENGINE_SPIKING_SPIKE_INPUT_H_
