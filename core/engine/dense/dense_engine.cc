#include "core/engine/dense/dense_engine.h"

#include <algorithm>
#include <cmath>
#include <deque>
#include <utility>

#include "core/contract/dcheck.h"
#include "core/engine/counting.h"
#include "core/engine/dense/integer_dense_pass.h"
#include "core/engine/prefix_engine.h"
#include "core/engine/token.h"
#include "core/math/exp.h"
#include "core/math/layer_norm.h"

namespace spikeserve {
namespace {

using FloatVector = std::vector<float>;

float Gelu(float x) {
  constexpr float kSqrtTwoOverPi = 0.7978845608028654f;
  return 0.5f * x * (1.0f + Tanh(kSqrtTwoOverPi * (x + 0.044715f * x * x * x)));
}

// Computes one token at a time, in the order of the sequence. `layers` [L] stores the keys and
// values of the earlier tokens.
class DensePass {
 public:
  // The key and the value of one token in one layer.
  struct KeyValue {
    TokenName token;
    FloatVector key;    // [d]
    FloatVector value;  // [d]
  };
  // Those of one layer that a query may attend to, oldest first.
  using KeyValues = std::deque<KeyValue>;

  DensePass(const Policy& policy, std::vector<KeyValues>& layers)
      : policy_(policy), layers_(layers) {}

  const Counts& counts() const { return counts_; }
  void ResetCounts() { counts_ = Counts(); }

  // Returns the token's output of the last layer [d], or an empty vector for returns and actions,
  // whose output of the last layer is not used. Records the token's attention in `trace` unless it
  // is null.
  FloatVector Run(const Token& token, Trace* trace = nullptr) {
    FloatVector x = Embed(token);
    for (int layer = 0; layer < policy_.config.layers; ++layer) {
      const LayerWeights& weights = policy_.weights.layers[layer];
      StoreKeysAndValues(layers_[layer], token, Affine(weights.key, x), Affine(weights.value, x));
      if (layer + 1 == policy_.config.layers && token.kind != TokenKind::kState) return {};
      const FloatVector merged = Attend(Affine(weights.query, x), layers_[layer],
                                        trace == nullptr ? nullptr : &trace->layers[layer]);
      AddResidual(weights.attention_norm, Affine(weights.attention_output, merged), x);
      FloatVector hidden = Affine(weights.ffn_hidden, x);
      for (float& h : hidden) h = Gelu(h);
      AddResidual(weights.ffn_norm, Affine(weights.ffn_output, hidden), x);
    }
    return x;
  }

  // Counts the operations of the action head, which is applied to the output of the state token.
  void CountHead(const FloatVector& readout) {
    counts_.multiply_accumulates += CountProducts(policy_.weights.head, readout);
  }

 private:
  // Returns W x + b. Counts the products in the same loop, because a second pass over the weights
  // (CountProducts) would slow down this engine in comparisons with the spiking engine.
  FloatVector Affine(const Linear& linear, const FloatVector& input) {
    FloatVector output = linear.bias.values;
    for (size_t i = 0; i < output.size(); ++i) {
      const float* row = linear.weight.values.data() + i * input.size();
      for (size_t j = 0; j < input.size(); ++j) {
        output[i] += row[j] * input[j];
        counts_.multiply_accumulates += row[j] != 0.0f && input[j] != 0.0f;
      }
    }
    return output;
  }

  void Normalize(const Norm& norm, FloatVector& x) {
    counts_.layer_norm_elements += x.size();
    LayerNorm(norm.weight.values.data(), norm.bias.values.data(), x.data(), x.size());
  }

  void AddResidual(const Norm& norm, const FloatVector& update, FloatVector& x) {
    for (size_t k = 0; k < x.size(); ++k) x[k] += update[k];
    Normalize(norm, x);
  }

  FloatVector Embed(const Token& token) {
    const Embedding& embedding = EmbeddingOf(policy_.weights, token.kind);
    FloatVector x = Affine(embedding.linear, token.input);
    const Tensor& timesteps = policy_.weights.embed_timestep;
    const int row = static_cast<int>(std::min<int64_t>(token.timestep, timesteps.shape[0] - 1));
    for (size_t k = 0; k < x.size(); ++k) x[k] += timesteps.at(row, static_cast<int>(k));
    Normalize(embedding.norm, x);
    return x;
  }

  void StoreKeysAndValues(KeyValues& tokens, const Token& token, FloatVector key,
                          FloatVector value) {
    const int64_t forgotten = token.timestep - policy_.config.context;
    while (!tokens.empty() && tokens.front().token.timestep <= forgotten) tokens.pop_front();
    tokens.push_back({{token.kind, token.timestep}, std::move(key), std::move(value)});
  }

  FloatVector Attend(const FloatVector& query, const KeyValues& tokens, LayerTrace* trace) {
    if (trace != nullptr) {
      for (const KeyValue& seen : tokens) trace->keys.push_back(seen.token);
    }
    const int size = policy_.config.head_size();
    const float scale = 1.0f / std::sqrt(static_cast<float>(size));
    FloatVector merged(query.size(), 0.0f);
    FloatVector weights(tokens.size());
    for (int first = 0; first < policy_.config.hidden_size; first += size) {
      for (size_t j = 0; j < tokens.size(); ++j) {
        float dot = 0.0f;
        for (int k = first; k < first + size; ++k) dot += query[k] * tokens[j].key[k];
        weights[j] = dot * scale;
      }
      const float best = *std::max_element(weights.begin(), weights.end());
      float sum = 0.0f;
      for (float& weight : weights) {
        weight = Exp(weight - best);
        sum += weight;
      }
      for (size_t j = 0; j < tokens.size(); ++j) {
        if (trace != nullptr) trace->attention.push_back(weights[j] / sum);
        for (int k = first; k < first + size; ++k)
          merged[k] += weights[j] / sum * tokens[j].value[k];
      }
      counts_.softmax_terms += tokens.size();
      counts_.attention_products += 2 * tokens.size() * static_cast<uint64_t>(size);
    }
    return merged;
  }

  const Policy& policy_;
  std::vector<KeyValues>& layers_;
  Counts counts_;
};

template <class Pass>
class DenseContext : public Engine::Context {
 public:
  DenseContext(int layer_count, int64_t first_timestep)
      : layers(layer_count), timestep(first_timestep) {}

  std::vector<typename Pass::KeyValues> layers;  // [L]
  int64_t timestep;                              // of the next token
  std::vector<float> previous_observation;       // see SetStateInput
  Counts action_counts;  // of the last action token; added to the next decision
};

class DenseReferenceEngine final : public PrefixEngine {
 public:
  using PrefixEngine::PrefixEngine;

 private:
  void Compute(const PrefixContext& prefix, Output* output) const override {
    ComputeDenseReference(policy(), prefix, output, /*trace=*/nullptr);
  }
};

template <class Pass>
class DenseStreamingEngine final : public Engine {
 public:
  explicit DenseStreamingEngine(std::shared_ptr<const Policy> policy)
      : policy_(std::move(policy)) {}

  const Policy& policy() const override { return *policy_; }

  std::unique_ptr<Context> NewContext(int64_t first_timestep) const override {
    return std::make_unique<DenseContext<Pass>>(policy_->config.layers, first_timestep);
  }

  void Decide(Context& context, float return_to_go, absl::Span<const float> observation,
              Output* output) const override {
    auto& dense = static_cast<DenseContext<Pass>&>(context);
    Pass pass(*policy_, dense.layers);
    pass.Run(ReturnToken(*policy_, dense.timestep, return_to_go));
    output->readout =
        pass.Run(StateToken(*policy_, dense.timestep, observation, &dense.previous_observation));
    pass.CountHead(output->readout);
    output->counts = std::exchange(dense.action_counts, Counts());
    output->counts += pass.counts();
  }

  void AppendAction(Context& context, absl::Span<const float> encoded_action) const override {
    auto& dense = static_cast<DenseContext<Pass>&>(context);
    Pass pass(*policy_, dense.layers);
    pass.Run(ActionToken(dense.timestep, encoded_action));
    dense.action_counts = pass.counts();
    ++dense.timestep;
  }

 private:
  std::shared_ptr<const Policy> policy_;
};

template <class Pass>
void Compute(const Policy& policy, const PrefixContext& prefix, Engine::Output* output,
             Trace* trace) {
  std::vector<typename Pass::KeyValues> layers(policy.config.layers);
  Pass pass(policy, layers);
  const std::vector<Token>& tokens = prefix.tokens();
  for (size_t i = 0; i < tokens.size(); ++i) {
    if (i == prefix.first_new_token()) pass.ResetCounts();
    output->readout = pass.Run(tokens[i], i + 1 == tokens.size() ? trace : nullptr);
  }
  pass.CountHead(output->readout);
  output->counts = pass.counts();
}

}  // namespace

void ComputeDenseReference(const Policy& policy, const PrefixContext& prefix,
                           Engine::Output* output, Trace* trace) {
  if (policy.config.is_integer()) return Compute<IntegerDensePass>(policy, prefix, output, trace);
  Compute<DensePass>(policy, prefix, output, trace);
}

std::unique_ptr<Engine> MakeDenseReferenceEngine(std::shared_ptr<const Policy> policy) {
  SPIKESERVE_DCHECK(policy->config.is_dense());
  return std::make_unique<DenseReferenceEngine>(std::move(policy));
}

std::unique_ptr<Engine> MakeDenseStreamingEngine(std::shared_ptr<const Policy> policy) {
  SPIKESERVE_DCHECK(policy->config.is_dense());
  if (policy->config.is_integer()) {
    return std::make_unique<DenseStreamingEngine<IntegerDensePass>>(std::move(policy));
  }
  return std::make_unique<DenseStreamingEngine<DensePass>>(std::move(policy));
}

}  // namespace spikeserve
