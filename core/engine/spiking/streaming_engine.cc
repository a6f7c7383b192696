#include "core/engine/spiking/streaming_engine.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "core/contract/dcheck.h"
#include "core/engine/spiking/attention_cache.h"
#include "core/engine/spiking/drive_builder.h"
#include "core/engine/spiking/head_bits.h"
#include "core/engine/spiking/integer_engine.h"
#include "core/engine/spiking/kernels/attention_kernels.h"
#include "core/engine/spiking/kernels/lif_kernels.h"
#include "core/engine/spiking/kernels/linear_kernels.h"
#include "core/engine/spiking/packed_engine.h"
#include "core/engine/spiking/packed_weights.h"
#include "core/engine/spiking/spike_input.h"
#include "core/engine/token.h"
#include "core/engine/token_costs.h"
#include "core/math/exp.h"

namespace spikeserve {
namespace {

class StreamingContext : public Engine::Context {
 public:
  StreamingContext(const ModelConfig& config, int64_t first_timestep)
      : timestep(first_timestep), band(config) {
    for (int layer = 0; layer < config.layers; ++layer) caches.emplace_back(config, band.slots());
  }

  int64_t timestep;                         // of the next token
  std::vector<float> previous_observation;  // see SetStateInput
  AttentionBand band;
  std::vector<AttentionCache> caches;  // [L]
  PhaseSpikes phase;                   // of the current timestep
  Counts action_counts;                // of the last action token; added to the next decision
  float* largest_residual = nullptr;   // see RecordLargestResidual
};

// A token that is being computed.
struct NewToken {
  StreamingContext* context = nullptr;
  Counts* counts = nullptr;  // of the decision that the token's cost belongs to
  TokenKind kind = TokenKind::kReturn;
  AlignedVector<float> x;         // [pad(d)]
  AlignedVector<uint32_t> query;  // [T][H][W], of the current layer
  AttentionBand band;             // the tokens it may attend to: the band up to itself, inclusive

  int slot() const { return band.Slot(context->timestep, kind); }
};

// Buffers of one thread, reused by its calls. Their contents do not outlive a call.
struct Scratch {
  std::vector<NewToken> tokens;
  std::vector<float> input;  // a token's embedding input
  SpikeInput spikes;         // into the current population
  DriveBuilder<float> drives;
  AlignedVector<uint32_t> bits;  // [T][pad(d) / 32]: keys, values or queries
  AlignedVector<uint32_t> keys;  // [T][H][W]
  AlignedVector<uint32_t> values;
  AlignedVector<float> y;        // [T][H][d_h]
  AlignedVector<float> routing;  // [pad(m)]
  AlignedVector<float> gates;    // [pad(H)]
  AlignedVector<float> merged;   // [d_h] or [d]
  AlignedVector<float> update;   // [pad(d)]
  AlignedVector<float> hidden;   // [pad(F)]
  kernels::ActiveInputs active;  // of the current linear map
};

Scratch& ThreadScratch() {
  thread_local Scratch scratch;
  return scratch;
}

// Computes new tokens of any number of contexts. The tokens of one context belong to the same
// timestep.
class TokenPass {
 public:
  TokenPass(const Policy& policy, const PackedWeights& packed)
      : policy_(policy),
        config_(policy.config),
        lif_{policy.config.membrane_decay, policy.config.threshold},
        packed_(packed),
        scratch_(ThreadScratch()) {}

  // Adds the next token of the context's timestep and computes its embedding from `input`. Its cost
  // is added to `counts`.
  void Add(StreamingContext& context, Counts& counts, TokenKind kind,
           absl::Span<const float> input) {
    if (scratch_.tokens.size() <= token_count_) scratch_.tokens.resize(token_count_ + 1);
    token_ = &scratch_.tokens[token_count_++];
    token_->context = &context;
    token_->counts = &counts;
    token_->kind = kind;
    context.band.Add(context.band.Slot(context.timestep, kind));
    token_->band = context.band;
    AddTokenCosts(config_, kind, token_->band.tokens(), &counts);
    Affine(EmbeddingOf(packed_, kind), input.data(), token_->x);
    Normalize(EmbeddingOf(policy_.weights, kind).norm);
  }

  // Computes all layers of the tokens, one matrix after the other, so that a matrix is loaded once
  // for all tokens. The keys and values of a token are stored before older tokens of its timestep
  // attend. They do not see them, because their bands do not contain the new token.
  void Run() {
    for (int layer = 0; layer < config_.layers; ++layer) {
      // In the last layer, only the state token's output is used.
      const auto needs_output = [&](const NewToken& token) {
        return layer + 1 < config_.layers || token.kind == TokenKind::kState;
      };
      const auto for_each_token = [&](auto visit) {
        for (size_t i = 0; i < token_count_; ++i) {
          token_ = &scratch_.tokens[i];
          visit(needs_output(*token_));
        }
      };
      for_each_token([&](bool has_output) { StoreKeysAndValues(layer, has_output); });
      for_each_token([&](bool has_output) {
        if (has_output) Attend(layer);
      });
      for_each_token([&](bool has_output) {
        if (has_output) FeedForward(layer);
      });
    }
  }

  // Writes the firing rates of the token that was added as number `index`. They are the presynaptic
  // activity of the action head.
  void Readout(size_t index, std::vector<float>* readout) {
    token_ = &scratch_.tokens[index];
    Code(policy_.weights.readout_coder, Stage::kReadout);
    scratch_.spikes.Rates(readout);
    counts().multiply_accumulates += scratch_.spikes.Synapses(packed_.head_nonzero);
  }

 private:
  using Drive = kernels::Drive<float>;

  float* x() { return token_->x.data(); }
  Counts& counts() { return *token_->counts; }
  const PhaseSpikes& phase() const { return token_->context->phase; }

  void Affine(const PackedLinear& map, const float* input, AlignedVector<float>& output) {
    output.resize(map.width);
    counts().multiply_accumulates += kernels::Affine(map, input, &scratch_.active, output.data());
  }

  void Normalize(const Norm& norm) {
    if (config_.has_norms()) {
      kernels::LayerNorm(norm.weight.values.data(), norm.bias.values.data(), x(),
                         config_.hidden_size);
    }
    if (float* const largest = token_->context->largest_residual; largest != nullptr) {
      for (int k = 0; k < config_.hidden_size; ++k) *largest = std::max(*largest, std::abs(x()[k]));
    }
  }

  void Code(const Coder& coder, Stage stage) {
    scratch_.spikes.Code(config_, packed_.periods, coder, x());
    counts().spikes(stage) += scratch_.spikes.total();
  }

  // Computes and stores the token's keys and values, and its query if its output is used.
  void StoreKeysAndValues(int layer, bool needs_query) {
    Code(policy_.weights.layers[layer].coder, Stage::kCoder);
    const uint64_t value_spikes = Project(packed_.layers[layer], needs_query);
    token_->context->caches[layer].Store(scratch_.keys.data(), scratch_.values.data(), value_spikes,
                                         token_->slot());
  }

  // x <- norm(x + W_O mean_t yhat(t) + b_O).
  void Attend(int layer) {
    const LayerWeights& weights = policy_.weights.layers[layer];
    const PackedLayer& packed = packed_.layers[layer];
    const AttentionCache& cache = token_->context->caches[layer];
    scratch_.y.resize(static_cast<size_t>(config_.ticks) * config_.hidden_size);
    counts().attention_products += cache.ValueSpikes(token_->band);
    const kernels::HeadScores scores = {.scale = weights.scale.values.data(),
                                        .weight = packed.attention_weight.data()};
    const kernels::Attended attended = kernels::Attend(
        cache.Window(token_->band), token_->query.data(), scores, scratch_.y.data());
    counts().attention_products += attended.products;
    Merge(packed, attended.ticks);
    Affine(packed.attention_output, scratch_.merged.data(), scratch_.update);
    AddResidual(weights.attention_norm);
  }

  // Computes keys, values and, if `needs_query`, queries: LIF(W [R || P] + b). Returns the number
  // of value spikes.
  uint64_t Project(const PackedLayer& packed, bool needs_query) {
    const PackedLinear& population = packed.key_value_query;
    const int section = PadToLanes(config_.hidden_size);
    const int width = needs_query ? 3 * section : 2 * section;
    const Drive& drive = scratch_.drives.Build(scratch_.spikes, population, width, &phase());
    const auto run = [&](int first, AlignedVector<uint32_t>& heads) {
      return RunSection(population, drive, first, section, heads);
    };
    counts().spikes(Stage::kKey) += run(0, scratch_.keys);
    const uint64_t value_spikes = run(section, scratch_.values);
    counts().spikes(Stage::kValue) += value_spikes;
    if (needs_query) counts().spikes(Stage::kQuery) += run(2 * section, token_->query);
    counts().accumulates += scratch_.spikes.Products(population.nonzero, &phase());
    if (!needs_query)
      counts().accumulates -= scratch_.spikes.Products(packed.nonzero_query, &phase());
    return value_spikes;
  }

  // Computes the spikes of the d neurons from lane `first` on and groups them by head, [T][H][W].
  // Returns the number of spikes.
  uint64_t RunSection(const PackedLinear& population, const Drive& drive, int first, int section,
                      AlignedVector<uint32_t>& heads) {
    const int size = config_.head_size();
    const int words = (size + 31) / 32;
    heads.resize(static_cast<size_t>(config_.ticks) * config_.heads * words);
    if (size % 32 == 0) {  // a head consists of whole words, so nothing has to be moved
      kernels::LifBits(lif_, population, drive, first, section, heads.data());
    } else {
      scratch_.bits.resize(static_cast<size_t>(config_.ticks) * section / kLanes);
      kernels::LifBits(lif_, population, drive, first, section, scratch_.bits.data());
      GroupByHead(config_, scratch_.bits.data(), heads.data());
    }
    return kernels::CountBits(heads.data(), static_cast<int>(heads.size()));
  }

  // Computes mean_t yhat(t): the gated heads (eq. 4.8 to 4.11), summed or concatenated. scratch_.y
  // contains only the `ticks` ticks at which a head's output is not zero; the other ticks add
  // nothing, whatever their gates are.
  void Merge(const PackedLayer& packed, int ticks) {
    const int stride =
        config_.has_routing() ? packed.routing_gate.width : PadToLanes(config_.heads);
    scratch_.gates.resize(static_cast<size_t>(ticks) * stride);
    if (config_.has_routing()) {
      Route(packed, ticks, stride);
    } else {
      const bool concat = config_.merge == Merge::kConcat;
      scratch_.gates.assign(scratch_.gates.size(),
                            concat ? 1.0f : 1.0f / static_cast<float>(config_.heads));
    }
    scratch_.merged.resize(config_.merged_size());
    kernels::GateHeads(
        {ticks, config_.ticks, config_.heads, config_.head_size(), scratch_.y.data()},
        scratch_.gates.data(), stride, config_.merge == Merge::kConcat, scratch_.merged.data());
  }

  // Computes the gates of the `ticks` ticks in scratch_.y, [ticks][stride]. The equations define
  // gates at the other ticks too, so their operations are counted, although they are not computed.
  void Route(const PackedLayer& packed, int ticks, int stride) {
    const PackedLinear& hidden = packed.routing_hidden;
    scratch_.routing.resize(static_cast<size_t>(ticks) * hidden.width);
    counts().multiply_accumulates +=
        kernels::AffineTicks(hidden, scratch_.y.data(), config_.hidden_size, ticks,
                             &scratch_.active, scratch_.routing.data());
    for (float& h : scratch_.routing) h = h > 0.0f ? h : 0.0f;
    counts().multiply_accumulates +=
        kernels::AffineTicks(packed.routing_gate, scratch_.routing.data(), hidden.width, ticks,
                             &scratch_.active, scratch_.gates.data());
    counts().multiply_accumulates += packed.silent_gate_products * (config_.ticks - ticks);
    if (config_.gate == Gate::kSigmoid) {
      for (float& gate : scratch_.gates) gate = Sigmoid(gate);
      return;
    }
    kernels::Softmax(scratch_.gates.data(), ticks, stride, config_.heads);
    if (config_.merge != Merge::kConcat) return;
    // Makes uniform gates 1.
    for (float& gate : scratch_.gates) gate *= static_cast<float>(config_.heads);
  }

  // x <- norm(x + W2 (spike count / T) + b2).
  void FeedForward(int layer) {
    const LayerWeights& weights = policy_.weights.layers[layer];
    const PackedLayer& packed = packed_.layers[layer];
    Code(weights.ffn_coder, Stage::kFfnIn);
    counts().multiply_accumulates +=
        scratch_.spikes.groups().empty() ? SilentUpdate(packed.silent_ffn) : HiddenUpdate(packed);
    AddResidual(weights.ffn_norm);
  }

  // Computes W2 (spike count / T) + b2 from the coder's spikes. Returns the number of products.
  uint64_t HiddenUpdate(const PackedLayer& packed) {
    const PackedLinear& population = packed.ffn_hidden;
    scratch_.hidden.resize(population.width);
    const Drive& drive =
        scratch_.drives.Build(scratch_.spikes, population, population.width, nullptr);
    counts().spikes(Stage::kFfnHidden) +=
        kernels::LifActivity(lif_, population, drive, scratch_.hidden.data());
    counts().accumulates += scratch_.spikes.Products(population.nonzero, nullptr);
    scratch_.update.resize(packed.ffn_output.width);
    return kernels::Affine(packed.ffn_output, scratch_.hidden.data(), &scratch_.active,
                           scratch_.update.data());
  }

  // The same if the coder is silent.
  uint64_t SilentUpdate(const SilentFeedForward& silent) {
    counts().spikes(Stage::kFfnHidden) += silent.spikes;
    scratch_.update = silent.update;
    return silent.products;
  }

  void AddResidual(const Norm& norm) {
    for (int k = 0; k < config_.hidden_size; ++k) x()[k] += scratch_.update[k];
    Normalize(norm);
  }

  const Policy& policy_;
  const ModelConfig& config_;
  const Lif lif_;
  const PackedWeights& packed_;
  Scratch& scratch_;
  size_t token_count_ = 0;
  NewToken* token_ = nullptr;  // the current token
};

class StreamingEngine final : public PackedEngine<PackedWeights> {
 public:
  using PackedEngine::PackedEngine;

  std::unique_ptr<Context> NewContext(int64_t first_timestep) const override {
    return std::make_unique<StreamingContext>(policy().config, first_timestep);
  }

  void Decide(Context& context, float return_to_go, absl::Span<const float> observation,
              Output* output) const override {
    const Decision decision = {&context, return_to_go, observation, output};
    DecideTogether(absl::MakeConstSpan(&decision, 1));
  }

  void AppendAction(Context& context, absl::Span<const float> encoded_action) const override {
    const TakenAction action = {&context, encoded_action};
    AppendActionsTogether(absl::MakeConstSpan(&action, 1));
  }

  void DecideTogether(absl::Span<const Decision> decisions) const override {
    TokenPass pass(policy(), packed());
    for (const Decision& decision : decisions) {
      auto& context = static_cast<StreamingContext&>(*decision.context);
      Counts& counts = decision.output->counts;
      counts = std::exchange(context.action_counts, Counts());
      context.band.Advance(context.timestep);
      context.phase.Set(policy(), context.timestep);
      counts.spikes(Stage::kPhase) += context.phase.generators.size();  // once per timestep
      const float standard_return = StandardizeReturn(policy(), decision.return_to_go);
      pass.Add(context, counts, TokenKind::kReturn, absl::MakeConstSpan(&standard_return, 1));
      std::vector<float>& input = ThreadScratch().input;
      SetStateInput(policy(), decision.observation, &context.previous_observation, &input);
      pass.Add(context, counts, TokenKind::kState, input);
    }
    pass.Run();
    for (size_t i = 0; i < decisions.size(); ++i) {
      pass.Readout(2 * i + 1, &decisions[i].output->readout);  // the second token is the state
    }
  }

  void AppendActionsTogether(absl::Span<const TakenAction> actions) const override {
    TokenPass pass(policy(), packed());
    for (const TakenAction& action : actions) {
      auto& context = static_cast<StreamingContext&>(*action.context);
      context.action_counts = Counts();
      pass.Add(context, context.action_counts, TokenKind::kAction, action.encoded_action);
    }
    pass.Run();
    for (const TakenAction& action : actions) {
      ++static_cast<StreamingContext&>(*action.context).timestep;
    }
  }
};

}  // namespace

void RecordLargestResidual(Engine::Context& context, float* largest) {
  SPIKESERVE_DCHECK(dynamic_cast<StreamingContext*>(&context) != nullptr);
  static_cast<StreamingContext&>(context).largest_residual = largest;
}

absl::StatusOr<std::unique_ptr<Engine>> MakeCompactSpikingEngine(Policy policy,
                                                                 const std::string& folder) {
  SPIKESERVE_DCHECK(!policy.config.is_dense());
  if (policy.config.is_integer()) return MakeCompactIntegerEngine(std::move(policy), folder);
  return MakeCompact<StreamingEngine, PackedWeights>(std::move(policy), folder);
}

std::unique_ptr<Engine> MakeSpikingStreamingEngine(std::shared_ptr<const Policy> policy) {
  SPIKESERVE_DCHECK(!policy->config.is_dense());
  if (policy->config.is_integer()) return MakeIntegerStreamingEngine(std::move(policy));
  return std::make_unique<StreamingEngine>(std::move(policy));
}

}  // namespace spikeserve
