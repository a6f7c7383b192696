#include "core/engine/streaming_engine.h"

#include <algorithm>
#include <utility>

#include "core/engine/attention_cache.h"
#include "core/engine/kernels/attention_kernels.h"
#include "core/engine/kernels/lif_kernels.h"
#include "core/engine/kernels/linear_kernels.h"
#include "core/engine/kernels/routing_kernels.h"
#include "core/engine/packed_weights.h"
#include "core/engine/spike_input.h"
#include "core/engine/token.h"
#include "core/math/exp.h"

namespace spikeserve {
namespace {

class StreamingContext : public Engine::Context {
 public:
  StreamingContext(const ModelConfig& config, uint64_t first_seed, int64_t first_timestep)
      : seed(first_seed), timestep(first_timestep), band(config) {
    for (int layer = 0; layer < config.layers; ++layer) caches.emplace_back(config, band.slots());
  }

  const uint64_t seed;
  int64_t timestep;  // of the next token
  AttentionBand band;
  std::vector<AttentionCache> caches;  // [L]
  PhaseSpikes phase;                   // of the running timestep
  Counts action_counts;                // of the last action token, borne by the next decision
};

// A token on its way through the layers.
struct NewToken {
  TokenKind kind = TokenKind::kReturn;
  std::vector<float> x;  // [pad(d)]
  AttentionBand band;    // what it may attend to: the band up to and with itself
};

// Buffers of a running computation; nothing in them outlives a call.
struct Scratch {
  std::vector<NewToken> tokens;
  std::vector<float> input;    // a token's embedding input
  SpikeInput spikes;           // into the population at hand
  std::vector<uint32_t> bits;  // [T][3 pad(d) / 32]: keys, values, queries
  std::vector<uint32_t> keys;  // [T][H][W]
  std::vector<uint32_t> values;
  std::vector<uint32_t> query;
  std::vector<float> y;        // [T][H][d_h]
  std::vector<float> routing;  // [pad(m)]
  std::vector<float> gates;    // [pad(H)]
  std::vector<float> merged;   // [d_h] or [d]
  std::vector<float> update;   // [pad(d)]
  std::vector<float> hidden;   // [pad(F)]
};

Scratch& ThreadScratch() {
  thread_local Scratch scratch;
  return scratch;
}

// Computes tokens of one timestep.
class TokenPass {
 public:
  TokenPass(const Policy& policy, const PackedWeights& packed, StreamingContext& context,
            Counts& counts)
      : policy_(policy),
        config_(policy.config),
        lif_{config_.membrane_decay, config_.threshold},
        packed_(packed),
        context_(context),
        counts_(counts),
        scratch_(ThreadScratch()) {}

  // Emitted once a timestep, whoever hears them.
  void CountPhase() { counts_.spikes(Stage::kPhase) += context_.phase.generators.size(); }

  // Takes in the next token of the timestep; `input` is what its embedding takes.
  void Add(TokenKind kind, absl::Span<const float> input) {
    context_.band.Add(context_.band.Slot(context_.timestep, kind));
    if (scratch_.tokens.size() <= token_count_) scratch_.tokens.resize(token_count_ + 1);
    token_ = &scratch_.tokens[token_count_++];
    token_->kind = kind;
    token_->band = context_.band;
    Affine(PackedEmbedding(), input.data(), token_->x);
    Normalize(EmbeddingOf(policy_.weights, kind).norm);
  }

  // Takes the tokens through all layers, layer by layer, so that a layer's weights are fetched once
  // for all of them.
  void Run() {
    for (int layer = 0; layer < config_.layers; ++layer) {
      for (size_t i = 0; i < token_count_; ++i) {
        token_ = &scratch_.tokens[i];
        // Nobody reads the other tokens' output of the last layer.
        Layer(layer,
              /*needs_output=*/layer + 1 < config_.layers || token_->kind == TokenKind::kState);
      }
    }
  }

  // Firing rates of the last token: the presynaptic activity of the action head.
  void Readout(std::vector<float>* readout) {
    Code(policy_.weights.readout_coder, 2 * config_.layers, Stage::kReadout);
    scratch_.spikes.Rates(readout);
    for (int j = 0; j < config_.hidden_size; ++j) {
      if ((*readout)[j] > 0.0f) counts_.multiply_accumulates += packed_.head_nonzero[j];
    }
  }

 private:
  float* x() { return token_->x.data(); }

  const PackedLinear& PackedEmbedding() const {
    return token_->kind == TokenKind::kReturn  ? packed_.embed_return
           : token_->kind == TokenKind::kState ? packed_.embed_state
                                               : packed_.embed_action;
  }

  void Affine(const PackedLinear& linear, const float* input, std::vector<float>& output) {
    output.resize(linear.width);
    counts_.multiply_accumulates += kernels::Affine(linear, input, output.data());
  }

  void Normalize(const Norm& norm) {
    kernels::LayerNorm(norm.weight.values.data(), norm.bias.values.data(), x(),
                       config_.hidden_size);
  }

  void Code(const Coder& coder, int site, Stage stage) {
    const BernoulliKey key = {.seed = context_.seed,
                              .timestep = context_.timestep,
                              .token = static_cast<int>(token_->kind),
                              .site = site};
    scratch_.spikes.Code(config_, packed_.periods, coder, x(), key);
    counts_.spikes(stage) += scratch_.spikes.total();
  }

  void Layer(int layer, bool needs_output) {
    const LayerWeights& weights = policy_.weights.layers[layer];
    const PackedLayer& packed = packed_.layers[layer];
    AttentionCache& cache = context_.caches[layer];
    Code(weights.coder, 2 * layer, Stage::kCoder);
    const uint64_t value_spikes = Project(packed, needs_output);
    cache.Store(scratch_.keys.data(), scratch_.values.data(), value_spikes,
                token_->band.Slot(context_.timestep, token_->kind));
    if (!needs_output) return;
    scratch_.y.resize(static_cast<size_t>(config_.ticks) * config_.hidden_size);
    counts_.attention_products += cache.ValueSpikes(token_->band);
    counts_.attention_products += kernels::Attend(cache.Window(token_->band), scratch_.query.data(),
                                                  packed.attention_weight.data(),
                                                  weights.scale.values.data(), scratch_.y.data());
    Merge(packed);
    Affine(packed.attention_output, scratch_.merged.data(), scratch_.update);
    AddResidual(weights.attention_norm);
    FeedForward(weights, packed, 2 * layer + 1);
  }

  // Keys, values and, where the token's output is read, queries: LIF(W [R || P] + b).
  // Returns the number of value spikes.
  uint64_t Project(const PackedLayer& packed, bool needs_query) {
    const PackedLinear& linear = packed.key_value_query;
    const int section = PadToLanes(config_.hidden_size);
    const int width = needs_query ? 3 * section : 2 * section;
    scratch_.bits.resize(static_cast<size_t>(config_.ticks) * width / kLanes);
    const kernels::Drive& drive = scratch_.spikes.DriveOf(linear, width, &context_.phase);
    kernels::LifBits(lif_, linear.bias.data(), drive, width, scratch_.bits.data());
    counts_.spikes(Stage::kKey) += TakeSection(width, 0, scratch_.keys);
    const uint64_t value_spikes = TakeSection(width, section, scratch_.values);
    counts_.spikes(Stage::kValue) += value_spikes;
    if (needs_query)
      counts_.spikes(Stage::kQuery) += TakeSection(width, 2 * section, scratch_.query);
    counts_.accumulates += scratch_.spikes.Products(linear.nonzero, &context_.phase);
    if (!needs_query)
      counts_.accumulates -= scratch_.spikes.Products(packed.nonzero_query, &context_.phase);
    return value_spikes;
  }

  // Cuts the d bits from `first` on of every tick into heads, [T][H][W]; returns the number of
  // spikes.
  uint64_t TakeSection(int width, int first, std::vector<uint32_t>& heads) {
    const int size = config_.head_size();
    const int words = (size + 31) / 32;
    heads.resize(static_cast<size_t>(config_.ticks) * config_.heads * words);
    uint32_t* out = heads.data();
    for (int tick = 0; tick < config_.ticks; ++tick) {
      const uint32_t* row = scratch_.bits.data() + static_cast<size_t>(tick) * width / kLanes;
      if (size % 32 == 0) {  // heads are whole words
        out = std::copy_n(row + first / 32, config_.heads * words, out);
        continue;
      }
      for (int head = 0; head < config_.heads; ++head) {
        for (int k = 0; k < size; k += 32) {
          *out++ = TakeBits(row, first + head * size + k, std::min(32, size - k));
        }
      }
    }
    return kernels::CountBits(heads.data(), static_cast<int>(heads.size()));
  }

  // `count` (1 to 32) bits of `row` from bit `first` on.
  static uint32_t TakeBits(const uint32_t* row, int first, int count) {
    const int shift = first % 32;
    uint64_t bits = row[first / 32] >> shift;
    if (shift + count > 32) bits |= static_cast<uint64_t>(row[first / 32 + 1]) << (32 - shift);
    return static_cast<uint32_t>(bits & ((uint64_t{1} << count) - 1));
  }

  // mean_t yhat(t): the gated heads (eq. 4.8 to 4.11), summed or side by side.
  void Merge(const PackedLayer& packed) {
    const int stride = PadToLanes(config_.heads);
    scratch_.gates.resize(static_cast<size_t>(config_.ticks) * stride);
    if (config_.has_routing()) {
      Route(packed, stride);
    } else {
      const bool concat = config_.merge == Merge::kConcat;
      scratch_.gates.assign(scratch_.gates.size(),
                            concat ? 1.0f : 1.0f / static_cast<float>(config_.heads));
    }
    scratch_.merged.resize(config_.merged_size());
    kernels::GateHeads({config_.ticks, config_.heads, config_.head_size(), scratch_.y.data()},
                       scratch_.gates.data(), stride, config_.merge == Merge::kConcat,
                       scratch_.merged.data());
  }

  // The gates of all ticks, [T][stride].
  void Route(const PackedLayer& packed, int stride) {
    const PackedLinear& hidden = packed.routing_hidden;
    scratch_.routing.resize(static_cast<size_t>(config_.ticks) * hidden.width);
    counts_.multiply_accumulates += kernels::AffineTicks(
        hidden, scratch_.y.data(), config_.hidden_size, config_.ticks, scratch_.routing.data());
    for (float& h : scratch_.routing) h = h > 0.0f ? h : 0.0f;
    counts_.multiply_accumulates +=
        kernels::AffineTicks(packed.routing_gate, scratch_.routing.data(), hidden.width,
                             config_.ticks, scratch_.gates.data());
    if (config_.gate == Gate::kSigmoid) {
      for (float& gate : scratch_.gates) gate = Sigmoid(gate);
      return;
    }
    kernels::Softmax(scratch_.gates.data(), config_.ticks, stride, config_.heads);
    if (config_.merge != Merge::kConcat) return;
    for (float& gate : scratch_.gates)
      gate *= static_cast<float>(config_.heads);  // so that uniform gates are 1
  }

  // x <- LayerNorm(x + W2 (spike count / T) + b2).
  void FeedForward(const LayerWeights& weights, const PackedLayer& packed, int site) {
    Code(weights.ffn_coder, site, Stage::kFfnIn);
    const PackedLinear& linear = packed.ffn_hidden;
    scratch_.hidden.resize(linear.width);
    const kernels::Drive& drive = scratch_.spikes.DriveOf(linear, linear.width, nullptr);
    counts_.spikes(Stage::kFfnHidden) +=
        kernels::LifRates(lif_, linear.bias.data(), drive, linear.width, scratch_.hidden.data());
    counts_.accumulates += scratch_.spikes.Products(linear.nonzero, nullptr);
    Affine(packed.ffn_output, scratch_.hidden.data(), scratch_.update);
    AddResidual(weights.ffn_norm);
  }

  void AddResidual(const Norm& norm) {
    for (int k = 0; k < config_.hidden_size; ++k) x()[k] += scratch_.update[k];
    Normalize(norm);
  }

  const Policy& policy_;
  const ModelConfig& config_;
  const Lif lif_;
  const PackedWeights& packed_;
  StreamingContext& context_;
  Counts& counts_;
  Scratch& scratch_;
  size_t token_count_ = 0;
  NewToken* token_ = nullptr;  // the one at hand
};

class StreamingEngine final : public Engine {
 public:
  explicit StreamingEngine(std::shared_ptr<const Policy> policy)
      : policy_(std::move(policy)), packed_(*policy_) {}

  const Policy& policy() const override { return *policy_; }

  std::unique_ptr<Context> NewContext(uint64_t seed, int64_t first_timestep) const override {
    return std::make_unique<StreamingContext>(policy_->config, seed, first_timestep);
  }

  void Decide(Context& context, float return_to_go, absl::Span<const float> observation,
              Output* output) const override {
    auto& streaming = static_cast<StreamingContext&>(context);
    output->counts = std::exchange(streaming.action_counts, Counts());
    streaming.band.Advance(streaming.timestep);
    streaming.phase.Set(*policy_, streaming.timestep);
    TokenPass pass(*policy_, packed_, streaming, output->counts);
    pass.CountPhase();
    const float standard_return = StandardizeReturn(*policy_, return_to_go);
    pass.Add(TokenKind::kReturn, absl::MakeConstSpan(&standard_return, 1));
    std::vector<float>& input = ThreadScratch().input;
    StandardizeObservation(*policy_, observation, &input);
    pass.Add(TokenKind::kState, input);
    pass.Run();
    pass.Readout(&output->readout);
  }

  void AppendAction(Context& context, absl::Span<const float> encoded_action) const override {
    auto& streaming = static_cast<StreamingContext&>(context);
    TokenPass pass(*policy_, packed_, streaming, streaming.action_counts);
    pass.Add(TokenKind::kAction, encoded_action);
    pass.Run();
    ++streaming.timestep;
  }

 private:
  std::shared_ptr<const Policy> policy_;
  PackedWeights packed_;
};

}  // namespace

std::unique_ptr<Engine> MakeSpikingStreamingEngine(std::shared_ptr<const Policy> policy) {
  return std::make_unique<StreamingEngine>(std::move(policy));
}

}  // namespace spikeserve
