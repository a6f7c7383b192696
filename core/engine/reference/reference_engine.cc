#include "core/engine/reference/reference_engine.h"

#include <algorithm>
#include <cmath>
#include <utility>
#include <vector>

#include "core/contract/dcheck.h"
#include "core/engine/reference/prefix_pass.h"
#include "core/math/exp.h"
#include "core/math/layer_norm.h"
#include "core/neuron/lif.h"
#include "core/neuron/phase.h"

namespace spikeserve {
namespace {

// The coder spikes of one token. The weights of neurons of equal period are added together.
struct CodedToken {
  std::vector<std::vector<int>> groups;  // [T]: the neurons of period n = 1 ... T; ascending
  SpikeTrain spikes;                     // [T][d]
};

// Returns the current into output neuron i at `tick` (1 ... T).
float Current(const Linear& linear, int i, const CodedToken& coded, const SpikeTrain& phase,
              int tick) {
  float current = linear.bias.values[i];
  for (int n = 1; n <= tick; ++n) {
    if (tick % n != 0) continue;
    float group = 0.0f;
    for (const int j : coded.groups[n - 1]) group += linear.weight.at(i, j);
    current += group;
  }
  const auto first_phase = static_cast<int>(coded.spikes[tick - 1].size());
  for (size_t k = 0; k < phase[tick - 1].size(); ++k) {
    if (phase[tick - 1][k]) current += linear.weight.at(i, first_phase + static_cast<int>(k));
  }
  return current;
}

// Returns W x + b. Starts with the bias and adds the products in ascending order of the input.
std::vector<float> Affine(const Linear& linear, const std::vector<float>& input) {
  std::vector<float> output = linear.bias.values;
  for (size_t i = 0; i < output.size(); ++i) {
    for (size_t j = 0; j < input.size(); ++j) {
      output[i] += linear.weight.at(static_cast<int>(i), static_cast<int>(j)) * input[j];
    }
  }
  return output;
}

// Returns the spike count of a neuron divided by T.
float Rate(const SpikeTrain& train, int neuron) {
  int count = 0;
  for (const auto& tick : train) count += tick[neuron];
  return static_cast<float>(count) / static_cast<float>(train.size());
}

// Returns LIF(W [R || P] + b), [T][out], where `phase` is [T][H], or [T][0] without phase spikes.
// A current is summed in the canonical order: the bias; then, for each period n that divides the
// tick, ascending, the sum over the neurons of that period, ascending; then the phase spikes by
// head.
SpikeTrain Fire(const ModelConfig& config, const Linear& linear, const CodedToken& coded,
                const SpikeTrain& phase) {
  const Lif lif = {config.membrane_decay, config.threshold};
  const int outputs = linear.weight.shape[0];
  SpikeTrain train(config.ticks, std::vector<uint8_t>(outputs, 0));
  for (int i = 0; i < outputs; ++i) {
    float membrane = 0.0f;
    for (int tick = 1; tick <= config.ticks; ++tick) {
      train[tick - 1][i] = lif.Step(Current(linear, i, coded, phase, tick), membrane);
    }
  }
  return train;
}

// Computes one decision over the whole episode. Symbols: T ticks, H heads, d hidden size, d_h head
// size, R coder spikes, P phase spikes.
class ReferencePass : private PrefixPass {
 public:
  ReferencePass(const Policy& policy, const PrefixContext& context, Trace* trace)
      : PrefixPass(policy, context, trace), lif_{config_.membrane_decay, config_.threshold} {}

  void Run(Engine::Output* output) {
    for (size_t i = 0; i < tokens_.size(); ++i) Embed(i);
    CountPhase();
    for (int layer = 0; layer < config_.layers; ++layer) Layer(layer);
    const size_t last = tokens_.size() - 1;
    const CodedToken coded = Code(policy_.weights.readout_coder, x_[last], last);
    AddSpikes(last, Stage::kReadout, kNoLayer, coded.spikes);
    output->readout.assign(config_.hidden_size, 0.0f);
    for (int j = 0; j < config_.hidden_size; ++j) output->readout[j] = Rate(coded.spikes, j);
    counts_.multiply_accumulates += CountProducts(policy_.weights.head, output->readout);
    output->counts = counts_;
  }

 private:
  void Normalize(size_t token, const Norm& norm, std::vector<float>& x) {
    if (!config_.has_norms()) return;
    LayerNorm(norm.weight.values.data(), norm.bias.values.data(), x.data(), x.size());
    if (IsNew(token)) counts_.layer_norm_elements += x.size();
  }

  void AddMultiplies(size_t token, const Linear& map, const std::vector<float>& input) {
    if (IsNew(token)) counts_.multiply_accumulates += CountProducts(map, input);
  }

  void Embed(size_t i) {
    const Embedding& embedding = EmbeddingOf(policy_.weights, tokens_[i].kind);
    std::vector<float> x = Affine(embedding.linear, tokens_[i].input);
    AddMultiplies(i, embedding.linear, tokens_[i].input);
    Normalize(i, embedding.norm, x);
    x_.push_back(std::move(x));
  }

  // Returns the phase spikes of a timestep (eq. 4.4): [T][H], or [T][0] without phase generators.
  SpikeTrain PhaseSpikes(int64_t timestep) const {
    SpikeTrain train(config_.ticks);
    if (!config_.has_phase()) return train;
    for (int tick = 0; tick < config_.ticks; ++tick) {
      const double time = config_.phase_clock == PhaseClock::kWindow
                              ? WindowPhaseTime(tick)
                              : TimestepPhaseTime(timestep, tick, config_.ticks);
      for (int k = 0; k < config_.heads; ++k) {
        train[tick].push_back(PhaseSpike(policy_.weights.phase_omega.values[k],
                                         policy_.weights.phase_phi.values[k], time));
      }
    }
    return train;
  }

  // Counts the phase spikes once per timestep, although several tokens and layers receive them.
  void CountPhase() {
    if (!config_.has_phase()) return;
    AddSpikes(tokens_.size() - 1, Stage::kPhase, kNoLayer, PhaseSpikes(tokens_.back().timestep));
  }

  CodedToken Code(const Coder& coder, const std::vector<float>& x, size_t token) {
    CodedToken coded;
    coded.groups.resize(config_.ticks);
    coded.spikes.assign(config_.ticks, std::vector<uint8_t>(x.size(), 0));
    for (size_t j = 0; j < x.size(); ++j) {
      if (IsNew(token)) {
        ++counts_.coder_gains;
        counts_.membrane_updates += config_.ticks;
      }
      const int period =
          lif_.Period(x[j] * coder.gain.values[j] + coder.bias.values[j], config_.ticks);
      if (period == 0) continue;  // silent
      coded.groups[period - 1].push_back(static_cast<int>(j));
      for (int tick = period; tick <= config_.ticks; tick += period) coded.spikes[tick - 1][j] = 1;
    }
    return coded;
  }

  // Returns the spikes of a population: [T][out].
  SpikeTrain Project(const Linear& population, const CodedToken& coded, const SpikeTrain& phase,
                     size_t token) {
    if (IsNew(token)) {
      for (int tick = 0; tick < config_.ticks; ++tick) {
        std::vector<uint8_t> input = coded.spikes[tick];
        input.insert(input.end(), phase[tick].begin(), phase[tick].end());
        counts_.accumulates += CountProducts(population, input);
        counts_.membrane_updates += population.bias.values.size();
      }
    }
    return Fire(config_, population, coded, phase);
  }

  void Layer(int layer) {
    const LayerWeights& weights = policy_.weights.layers[layer];
    const bool last_layer = layer + 1 == config_.layers;
    keys_.clear();
    values_.clear();
    for (size_t i = 0; i < tokens_.size(); ++i) {
      const CodedToken coded = Code(weights.coder, x_[i], i);
      const SpikeTrain phase = PhaseSpikes(tokens_[i].timestep);
      // In the last layer, only the state token's output is used.
      const bool has_output = !last_layer || tokens_[i].kind == TokenKind::kState;
      SpikeTrain query;
      keys_.push_back(Project(weights.key, coded, phase, i));
      values_.push_back(Project(weights.value, coded, phase, i));
      if (has_output) query = Project(weights.query, coded, phase, i);
      AddSpikes(i, Stage::kCoder, layer, coded.spikes);
      AddSpikes(i, Stage::kKey, layer, keys_[i]);
      AddSpikes(i, Stage::kValue, layer, values_[i]);
      if (!has_output) continue;
      AddSpikes(i, Stage::kQuery, layer, query);
      Attention(layer, query, i);
      FeedForward(layer, i);
    }
  }

  // Returns y_h(t) of one token at one tick and head: [d_h]. Scores are integers times c_h, so the
  // softmax weight of a key depends only on the distance between its overlap and the best overlap.
  // The values of all keys at one distance are counted as integers first, and then multiplied by
  // their common weight.
  std::vector<float> AttendHead(int layer, const SpikeTrain& query, size_t i, int tick, int head) {
    const float scale = policy_.weights.layers[layer].scale.values[head];
    const int size = config_.head_size();
    std::vector<std::pair<int, size_t>> keys;  // overlap, token
    for (size_t j = 0; j <= i; ++j) {
      if (!IsInBand(i, j)) continue;
      int overlap = 0;
      for (int k = head * size; k < (head + 1) * size; ++k) {
        overlap += query[tick][k] & keys_[j][tick][k];
        if (IsNew(i)) counts_.attention_products += values_[j][tick][k];
      }
      if (IsNew(i)) counts_.attention_products += overlap;
      if (IsNew(i)) ++counts_.softmax_terms;
      keys.emplace_back(overlap, j);
    }
    const auto [lowest, highest] = std::minmax_element(keys.begin(), keys.end());
    const int best = scale >= 0.0f ? highest->first : lowest->first;
    std::vector<float> y(size, 0.0f);
    float sum = 0.0f;
    for (int distance = 0; distance <= size; ++distance) {
      std::vector<int> counts(size, 0);
      int members = 0;
      for (const auto& [overlap, j] : keys) {
        if (std::abs(overlap - best) != distance) continue;
        ++members;
        for (int k = 0; k < size; ++k) counts[k] += values_[j][tick][head * size + k];
      }
      const float weight = Exp(-std::abs(scale) * static_cast<float>(distance));
      sum += weight * static_cast<float>(members);
      for (int k = 0; k < size; ++k) y[k] += weight * static_cast<float>(counts[k]);
    }
    const float inverse = 1.0f / sum;
    for (float& value : y) value *= inverse;
    if (trace_ != nullptr && i + 1 == tokens_.size()) {
      for (const auto& [overlap, j] : keys) {
        const auto distance = static_cast<float>(std::abs(overlap - best));
        trace_->layers[layer].attention.push_back(Exp(-std::abs(scale) * distance) * inverse);
      }
    }
    return y;
  }

  // Returns the gates over the heads (eq. 4.8 to 4.10) for u = concat_h y_h(t) [d]: [H].
  std::vector<float> Gates(const LayerWeights& weights, const std::vector<float>& u, size_t token) {
    const auto heads = static_cast<float>(config_.heads);
    if (!config_.has_routing()) {
      return std::vector<float>(config_.heads,
                                config_.merge == Merge::kConcat ? 1.0f : 1.0f / heads);
    }
    std::vector<float> hidden = Affine(weights.routing_hidden, u);
    for (float& h : hidden) h = h > 0.0f ? h : 0.0f;
    std::vector<float> gates = Affine(weights.routing_gate, hidden);
    AddMultiplies(token, weights.routing_hidden, u);
    AddMultiplies(token, weights.routing_gate, hidden);
    if (config_.gate == Gate::kSigmoid) {
      for (float& gate : gates) gate = Sigmoid(gate);
      return gates;
    }
    const float best = *std::max_element(gates.begin(), gates.end());
    float sum = 0.0f;
    for (float& gate : gates) {
      gate = Exp(gate - best);
      sum += gate;
      if (IsNew(token)) ++counts_.softmax_terms;
    }
    for (float& gate : gates) {
      gate /= sum;
      if (config_.merge == Merge::kConcat) gate *= heads;  // makes uniform gates 1
    }
    return gates;
  }

  // Records the gates of token i at one tick. Called for every tick in ascending order.
  void RecordGates(int layer, size_t i, const std::vector<float>& gates) {
    if (trace_ == nullptr || !config_.has_routing() || !IsRead(i, layer)) return;
    LayerTrace& trace = trace_->layers[layer];
    if (trace.gated.empty() || trace.gated.back() != Name(i)) trace.gated.push_back(Name(i));
    trace.gates.insert(trace.gates.end(), gates.begin(), gates.end());
  }

  // x <- norm(x + W_O mean_t yhat(t) + b_O), where yhat(t) is the sum (eq. 4.11) or the
  // concatenation of the gated heads.
  void Attention(int layer, const SpikeTrain& query, size_t i) {
    const LayerWeights& weights = policy_.weights.layers[layer];
    RecordKeys(layer, i);
    const int size = config_.head_size();
    std::vector<float> merged(config_.merged_size(), 0.0f);
    for (int tick = 0; tick < config_.ticks; ++tick) {
      std::vector<float> u;
      for (int head = 0; head < config_.heads; ++head) {
        const std::vector<float> y = AttendHead(layer, query, i, tick, head);
        u.insert(u.end(), y.begin(), y.end());
      }
      const std::vector<float> gates = Gates(weights, u, i);
      RecordGates(layer, i, gates);
      std::vector<float> routed(merged.size(), 0.0f);
      for (int k = 0; k < config_.hidden_size; ++k) {
        routed[config_.merge == Merge::kConcat ? k : k % size] += gates[k / size] * u[k];
        // Without routing the gates are constants.
        if (IsNew(i) && config_.has_routing()) ++counts_.gate_products;
      }
      for (size_t k = 0; k < merged.size(); ++k) merged[k] += routed[k];
    }
    for (float& value : merged) value /= static_cast<float>(config_.ticks);
    AddMultiplies(i, weights.attention_output, merged);
    AddResidual(i, Affine(weights.attention_output, merged), weights.attention_norm);
  }

  // x <- norm(x + W2 (spike count / T) + b2).
  void FeedForward(int layer, size_t i) {
    const LayerWeights& weights = policy_.weights.layers[layer];
    const CodedToken coded = Code(weights.ffn_coder, x_[i], i);
    const SpikeTrain hidden = Project(weights.ffn_hidden, coded, SpikeTrain(config_.ticks), i);
    AddSpikes(i, Stage::kFfnIn, layer, coded.spikes);
    AddSpikes(i, Stage::kFfnHidden, layer, hidden);
    std::vector<float> rates;
    for (int j = 0; j < config_.ffn_size; ++j) rates.push_back(Rate(hidden, j));
    AddMultiplies(i, weights.ffn_output, rates);
    AddResidual(i, Affine(weights.ffn_output, rates), weights.ffn_norm);
  }

  void AddResidual(size_t i, const std::vector<float>& update, const Norm& norm) {
    for (size_t k = 0; k < update.size(); ++k) x_[i][k] += update[k];
    Normalize(i, norm, x_[i]);
  }

  const Lif lif_;
  std::vector<std::vector<float>> x_;  // [tokens][d]
  std::vector<SpikeTrain> keys_;       // of the current layer, [tokens][T][d]
  std::vector<SpikeTrain> values_;
};

class ReferenceEngine final : public PrefixEngine {
 public:
  using PrefixEngine::PrefixEngine;

 private:
  void Compute(const PrefixContext& prefix, Output* output) const override {
    ComputeSpikingReference(policy(), prefix, output, /*trace=*/nullptr);
  }
};

}  // namespace

void ComputeSpikingReference(const Policy& policy, const PrefixContext& prefix,
                             Engine::Output* output, Trace* trace) {
  if (policy.config.is_integer()) return ComputeIntegerReference(policy, prefix, output, trace);
  ReferencePass(policy, prefix, trace).Run(output);
}

std::unique_ptr<Engine> MakeSpikingReferenceEngine(std::shared_ptr<const Policy> policy) {
  SPIKESERVE_DCHECK(!policy->config.is_dense());
  return std::make_unique<ReferenceEngine>(std::move(policy));
}

}  // namespace spikeserve
