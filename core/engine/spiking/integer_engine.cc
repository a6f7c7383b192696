#include "core/engine/spiking/integer_engine.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <utility>
#include <vector>

#include "core/contract/dcheck.h"
#include "core/engine/fixed_point_maps.h"
#include "core/engine/spiking/drive_builder.h"
#include "core/engine/spiking/head_bits.h"
#include "core/engine/spiking/integer_attention.h"
#include "core/engine/spiking/integer_cache.h"
#include "core/engine/spiking/kernels/event_kernels.h"
#include "core/engine/spiking/kernels/lif_kernels.h"
#include "core/engine/spiking/kernels/norm_kernel.h"
#include "core/engine/spiking/packed_engine.h"
#include "core/engine/spiking/packed_integer_policy.h"
#include "core/engine/spiking/spike_input.h"
#include "core/engine/token.h"
#include "core/engine/token_costs.h"
#include "core/math/fixed_point.h"
#include "core/neuron/shift_lif.h"

namespace spikeserve {
namespace {

using Drive = kernels::Drive<int16_t>;

class IntegerContext : public Engine::Context {
 public:
  IntegerContext(const ModelConfig& config, int64_t first_timestep)
      : timestep(first_timestep), band(config) {
    for (int layer = 0; layer < config.layers; ++layer) caches.emplace_back(config);
  }

  // Removes the tokens of timestep - N from the band.
  void Advance(int context) {
    for (int slot = band.Expire(timestep - context + 1); slot >= 0;
         slot = band.Expire(timestep - context + 1)) {
      for (IntegerCache& cache : caches) cache.Remove(slot);
    }
  }

  int64_t timestep;                         // of the next token
  std::vector<float> previous_observation;  // see SetStateInput
  IntegerBand band;
  std::vector<IntegerCache> caches;       // [L]
  PhaseSpikes phase;                      // of the current timestep
  Counts action_counts;                   // of the last action token; added to the next decision
  HiddenSpikes* hidden_spikes = nullptr;  // see RecordHiddenSpikes
};

// Buffers of one thread, reused by its calls. Their contents do not outlive a call.
struct IntegerScratch {
  std::vector<float> floats;  // a token's standardised input
  AlignedVector<int16_t> x;   // the residual stream, [pad(d)]
  SpikeInput spikes;          // into the current population
  DriveBuilder<int16_t> drives;
  AlignedVector<uint32_t> bits;  // [T][pad(d) / 32]
  AlignedVector<uint32_t> keys;  // [T][H][W]
  AlignedVector<uint32_t> query;
  AlignedVector<int16_t> counts;  // of the values, [planes][pad(d)]
  AlignedVector<int16_t> hidden;  // [pad(F)]
  AlignedVector<int16_t> y;       // [pad(d)]
  AlignedVector<int16_t> input;   // of a map, padded
  AlignedVector<int32_t> sums;    // outputs of a map, padded
  AlignedVector<int32_t> merged;  // sums over ticks, [pad(d_h)] or [pad(d)]
  std::vector<TickGroup> groups;
  std::vector<int32_t> gates;  // [H]
  IntegerAttention attention;
  kernels::ActiveInputs active;  // of the current map
};

IntegerScratch& ThreadIntegerScratch() {
  thread_local IntegerScratch scratch;
  return scratch;
}

// Computes new tokens, one after the other.
class IntegerTokenPass {
 public:
  IntegerTokenPass(const Policy& policy, const PackedIntegerPolicy& packed)
      : policy_(policy),
        config_(policy.config),
        packed_(packed),
        lif_{policy.config.leak()},
        scratch_(ThreadIntegerScratch()) {}

  // Computes the next token of the context's timestep from its standardised `input`, and adds its
  // cost to `counts`.
  void Run(IntegerContext& context, Counts& counts, TokenKind kind, absl::Span<const float> input) {
    context_ = &context;
    counts_ = &counts;
    counts.weight_bytes += SharedWeightBytes(config_, kind, static_cast<int>(input.size()),
                                             policy_.action_space.size());
    Embed(kind, input);
    const int slot = context.band.Add(context.timestep);
    for (int layer = 0; layer < config_.layers; ++layer) {
      // In the last layer, only the state token's output is used.
      const bool has_output = layer + 1 < config_.layers || kind == TokenKind::kState;
      StoreKeysAndValues(layer, slot, has_output);
      if (!has_output) return;
      Attend(layer);
      FeedForward(layer);
    }
  }

  // Writes the firing rates of the token that was computed last.
  void Readout(std::vector<float>* readout) {
    Code(packed_.readout_coder, Stage::kReadout);
    scratch_.spikes.Rates(readout);
    counts_->multiply_accumulates += scratch_.spikes.Synapses(packed_.head_nonzero);
  }

 private:
  void Embed(TokenKind kind, absl::Span<const float> input) {
    const PackedEmbedding& embedding = EmbeddingOf(packed_, kind);
    AssignZeros(&scratch_.input, PadToLanes(static_cast<int>(input.size())));
    const auto unit = static_cast<float>(1 << config_.input_fraction);
    for (size_t i = 0; i < input.size(); ++i) {
      const float scaled = std::clamp<float>(input[i] * unit, -kLargestResidual, kLargestResidual);
      scratch_.input[i] = static_cast<int16_t>(std::nearbyint(scaled));
    }
    AssignZeros(&scratch_.x, PadToLanes(config_.hidden_size));
    counts_->wide_multiply_accumulates += Apply(embedding.linear, scratch_.input);
    Normalize(embedding.norm);
  }

  // Sets scratch_.sums to the outputs of a map. Returns the number of its products.
  uint64_t Apply(const PackedFixedPointMap& map, const AlignedVector<int16_t>& input) {
    scratch_.sums.resize(map.width);
    const uint64_t products =
        kernels::Apply(map, input.data(), &scratch_.active, scratch_.sums.data());
    counts_->multiply_accumulates += products;
    counts_->integer_multiply_accumulates += products;
    return products;
  }

  // x <- norm(x + scratch_.sums).
  void Normalize(const PackedNorm& norm) {
    if (!config_.has_norms()) {
      return kernels::AddLimited(PadToLanes(config_.hidden_size), scratch_.sums.data(),
                                 scratch_.x.data());
    }
    kernels::Normalize(norm, scratch_.sums.data(), scratch_.x.data());
    counts_->layer_norm_elements += static_cast<uint64_t>(norm.size);
  }

  void Code(const PackedPeriodCoder& coder, Stage stage) {
    scratch_.spikes.Code(coder, scratch_.x.data());
    counts_->spikes(stage) += scratch_.spikes.total();
    counts_->coder_gains += static_cast<uint64_t>(config_.hidden_size);
  }

  // Counts the updates of `neurons` neurons that receive `drive`.
  void CountMembranes(const Drive& drive, int neurons) {
    const auto number = static_cast<uint64_t>(neurons);
    uint64_t last = 0;
    for (int tick = 1; tick <= drive.ticks; ++tick) {
      if (drive.offsets[tick] == drive.offsets[tick - 1]) continue;
      counts_->membrane_updates += number;
      last = static_cast<uint64_t>(tick);
    }
    if (last == 0) return;
    counts_->membrane_leaks += number * (last - 1);
    counts_->driven_neurons += number;
  }

  // Counts the products of the input spikes with weights, and the weights that are read.
  void CountSynapses(absl::Span<const uint32_t> nonzero, const PhaseSpikes* phase) {
    counts_->accumulates += scratch_.spikes.Products(nonzero, phase);
    counts_->weight_bytes += scratch_.spikes.Rows(nonzero, phase);
  }

  // Computes and stores the token's keys and values, and its query if its output is used.
  void StoreKeysAndValues(int layer, int slot, bool needs_query) {
    const PackedIntegerLayer& packed = packed_.layers[layer];
    const PackedIntegerPopulation& population = packed.key_value_query;
    const PhaseSpikes& phase = context_->phase;
    Code(packed.coder, Stage::kCoder);
    const int section = PadToLanes(config_.hidden_size);
    const int width = needs_query ? 3 * section : 2 * section;
    const Drive& drive = scratch_.drives.Build(scratch_.spikes, population, width, &phase);
    CountMembranes(drive, (needs_query ? 3 : 2) * config_.hidden_size);
    counts_->spikes(Stage::kKey) += FireBits(population, drive, 0, scratch_.keys);
    CountValues(population, drive, section);
    if (needs_query) {
      query_spikes_ = FireBits(population, drive, 2 * section, scratch_.query);
      counts_->spikes(Stage::kQuery) += query_spikes_;
    }
    absl::Span<const uint32_t> nonzero = population.nonzero;
    if (!needs_query) nonzero = packed.nonzero_key_value;
    CountSynapses(nonzero, &phase);
    const uint64_t values =
        context_->caches[layer].Store(slot, scratch_.keys.data(), scratch_.counts.data());
    // A value enters the sum of all values now, and leaves it later.
    const uint64_t sums = 2 * values;
    counts_->attention_products += sums;
    counts_->attention_bytes += SpikeBytes(config_.ticks, config_.hidden_size) +
                                ValueBytes(config_, config_.ticks, config_.hidden_size) +
                                sums * 2 * sizeof(int16_t);
  }

  // Sets scratch_.counts to the spike counts of the values, whose first lane is `section`.
  void CountValues(const PackedIntegerPopulation& population, const Drive& drive, int section) {
    AlignedVector<int16_t>& counts = scratch_.counts;
    counts.resize(static_cast<size_t>(config_.attention_planes()) * section);
    if (config_.attention_planes() == 1) {
      counts_->spikes(Stage::kValue) +=
          kernels::LifCounts(lif_, population, drive, section, section, counts.data());
      return;
    }
    scratch_.bits.resize(counts.size() / kLanes);
    kernels::LifBits(lif_, population, drive, section, section, scratch_.bits.data());
    for (size_t i = 0; i < counts.size(); ++i) {
      counts[i] = static_cast<int16_t>(scratch_.bits[i / kLanes] >> (i % kLanes) & 1);
    }
    counts_->spikes(Stage::kValue) +=
        kernels::CountBits(scratch_.bits.data(), static_cast<int>(scratch_.bits.size()));
  }

  // Sets `heads` [T][H][W] to the spikes of the d neurons from lane `first` on. Returns their
  // number.
  uint64_t FireBits(const PackedIntegerPopulation& population, const Drive& drive, int first,
                    AlignedVector<uint32_t>& heads) {
    const int section = PadToLanes(config_.hidden_size);
    const int words = (config_.head_size() + 31) / 32;
    heads.resize(static_cast<size_t>(config_.ticks) * config_.heads * words);
    if (config_.head_size() % 32 == 0) {  // a head consists of whole words
      kernels::LifBits(lif_, population, drive, first, section, heads.data());
    } else {
      scratch_.bits.resize(static_cast<size_t>(config_.ticks) * section / kLanes);
      kernels::LifBits(lif_, population, drive, first, section, scratch_.bits.data());
      GroupByHead(config_, scratch_.bits.data(), heads.data());
    }
    return kernels::CountBits(heads.data(), static_cast<int>(heads.size()));
  }

  // x <- norm(x + W_O yhat + b_O).
  void Attend(int layer) {
    const PackedIntegerLayer& packed = packed_.layers[layer];
    const FixedPointLayer& weights = policy_.weights.layers[layer].fixed_point;
    const IntegerKeys keys = {.config = config_,
                              .scales = weights.attention_scale.values,
                              .band = context_->band,
                              .cache = context_->caches[layer],
                              .query = query_spikes_ > 0 ? scratch_.query.data() : nullptr};
    AssignZeros(&scratch_.y, PadToLanes(config_.hidden_size));
    AssignZeros(&scratch_.merged, PadToLanes(config_.merged_size()));
    GroupTicks(keys, &scratch_.groups);
    // Where one group has all ticks, their number would be a factor of the sums and of the divisor.
    const bool is_one = scratch_.groups.size() == 1;
    for (const TickGroup& group : scratch_.groups) {
      scratch_.attention.Attend(keys, group, scratch_.y.data(), counts_);
      AddHeads(packed, is_one ? 1 : static_cast<int>(group.size()) * config_.plane_ticks());
    }
    MergeHeads(is_one ? 1 : config_.ticks);
    Apply(packed.attention_output, scratch_.input);
    Normalize(packed.attention_norm);
  }

  // Adds the heads in scratch_.y, times their gates and `ticks`, to scratch_.merged. Up to 64 heads
  // of at most 255, with gates of at most 256, keep all sums over 255 ticks within 30 bits.
  void AddHeads(const PackedIntegerLayer& packed, int32_t ticks) {
    const int size = config_.head_size();
    const bool concat = config_.merge == Merge::kConcat;
    scratch_.gates.assign(config_.heads, 1);
    if (config_.has_routing()) Route(packed);
    ticks *= config_.gate_factor();
    for (int head = 0; head < config_.heads; ++head) {
      kernels::AddScaled(scratch_.y.data() + head * size, size, scratch_.gates[head] * ticks,
                         scratch_.merged.data() + (concat ? head * size : 0));
    }
  }

  // Sets scratch_.input to the merged heads over `ticks`, [pad(d_h)] or [pad(d)].
  void MergeHeads(int32_t ticks) {
    int32_t divisor = config_.merge == Merge::kConcat ? 1 : config_.heads;
    if (config_.has_routing()) divisor = 1 << kGateFraction;
    divisor *= ticks;
    scratch_.input.resize(scratch_.merged.size());
    if (std::has_single_bit(static_cast<uint32_t>(divisor))) {
      const int shift = std::countr_zero(static_cast<uint32_t>(divisor));
      Limit([=](int32_t sum) { return (sum + divisor / 2) >> shift; });
    } else {
      Limit([=](int32_t sum) { return (2 * sum + divisor) / (2 * divisor); });
    }
  }

  // Sets scratch_.input to the quotients of scratch_.merged.
  template <class Quotient>
  void Limit(Quotient quotient) {
    for (size_t k = 0; k < scratch_.input.size(); ++k) {
      const int32_t merged = std::min(quotient(scratch_.merged[k]), int32_t{kLargestAttended});
      scratch_.input[k] = static_cast<int16_t>(merged);
    }
  }

  // Sets scratch_.gates for the heads in scratch_.y.
  void Route(const PackedIntegerLayer& packed) {
    counts_->gate_products += static_cast<uint64_t>(config_.hidden_size);
    Apply(packed.routing_hidden, scratch_.y);
    AssignZeros(&scratch_.input, PadToLanes(config_.routing_hidden_size));
    for (int j = 0; j < config_.routing_hidden_size; ++j) {
      scratch_.input[j] = static_cast<int16_t>(std::clamp(scratch_.sums[j], 0, kLargestResidual));
    }
    counts_->wide_multiply_accumulates += Apply(packed.routing_gate, scratch_.input);
    std::vector<int32_t>& gates = scratch_.gates;
    gates.assign(scratch_.sums.begin(), scratch_.sums.begin() + config_.heads);
    counts_->softmax_terms += GateScores(config_, gates);
  }

  // x <- norm(x + W2 (spike counts) + b2).
  void FeedForward(int layer) {
    const PackedIntegerLayer& packed = packed_.layers[layer];
    const PackedIntegerPopulation& population = packed.ffn_hidden;
    Code(packed.ffn_coder, Stage::kFfnIn);
    const Drive& drive =
        scratch_.drives.Build(scratch_.spikes, population, population.width, nullptr);
    CountMembranes(drive, config_.ffn_size);
    scratch_.hidden.resize(population.width);
    counts_->spikes(Stage::kFfnHidden) +=
        kernels::LifCounts(lif_, population, drive, 0, population.width, scratch_.hidden.data());
    if (context_->hidden_spikes != nullptr) {
      std::vector<uint64_t>& sums = (*context_->hidden_spikes)[layer];
      for (size_t j = 0; j < sums.size(); ++j) sums[j] += static_cast<uint64_t>(scratch_.hidden[j]);
    }
    CountSynapses(population.nonzero, nullptr);
    counts_->weight_bytes += Apply(packed.ffn_output, scratch_.hidden);
    Normalize(packed.ffn_norm);
  }

  const Policy& policy_;
  const ModelConfig& config_;
  const PackedIntegerPolicy& packed_;
  const ShiftLif lif_;
  IntegerScratch& scratch_;
  IntegerContext* context_ = nullptr;
  Counts* counts_ = nullptr;
  uint64_t query_spikes_ = 0;  // of the current layer
};

class IntegerEngine final : public PackedEngine<PackedIntegerPolicy> {
 public:
  using PackedEngine::PackedEngine;

  std::unique_ptr<Context> NewContext(int64_t first_timestep) const override {
    return std::make_unique<IntegerContext>(policy().config, first_timestep);
  }

  void Decide(Context& context, float return_to_go, absl::Span<const float> observation,
              Output* output) const override {
    auto& integers = static_cast<IntegerContext&>(context);
    Counts& counts = output->counts;
    counts = std::exchange(integers.action_counts, Counts());
    integers.Advance(policy().config.context);
    integers.phase.Set(packed().phases, policy().config.ticks, integers.timestep);
    counts.spikes(Stage::kPhase) += integers.phase.generators.size();  // once per timestep
    IntegerTokenPass pass(policy(), packed());
    const float standard_return = StandardizeReturn(policy(), return_to_go);
    pass.Run(integers, counts, TokenKind::kReturn, absl::MakeConstSpan(&standard_return, 1));
    std::vector<float>& input = ThreadIntegerScratch().floats;
    SetStateInput(policy(), observation, &integers.previous_observation, &input);
    pass.Run(integers, counts, TokenKind::kState, input);
    pass.Readout(&output->readout);
  }

  void AppendAction(Context& context, absl::Span<const float> encoded_action) const override {
    auto& integers = static_cast<IntegerContext&>(context);
    integers.action_counts = Counts();
    IntegerTokenPass(policy(), packed())
        .Run(integers, integers.action_counts, TokenKind::kAction, encoded_action);
    ++integers.timestep;
  }
};

}  // namespace

void RecordHiddenSpikes(Engine::Context& context, HiddenSpikes* spikes) {
  SPIKESERVE_DCHECK(dynamic_cast<IntegerContext*>(&context) != nullptr);
  static_cast<IntegerContext&>(context).hidden_spikes = spikes;
}

std::unique_ptr<Engine> MakeIntegerStreamingEngine(std::shared_ptr<const Policy> policy) {
  return std::make_unique<IntegerEngine>(std::move(policy));
}

absl::StatusOr<std::unique_ptr<Engine>> MakeCompactIntegerEngine(Policy policy,
                                                                 const std::string& folder) {
  return MakeCompact<IntegerEngine, PackedIntegerPolicy>(std::move(policy), folder);
}

}  // namespace spikeserve
