#include "train/model/torch_model.h"

#include <ATen/ops/gelu.h>

#include <algorithm>
#include <cmath>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "core/model/policy.h"
#include "core/quantize/quantize_integer.h"
#include "train/model/attention.h"
#include "train/model/integer_forward.h"
#include "train/neuron/lif_function.h"
#include "train/neuron/phase_function.h"

namespace spikeserve {
namespace {

// A smaller weight would leave nothing of the stream that can be divided by it.
constexpr double kSmallestWeight = 1e-6;

// What the stream without norms is multiplied by to give the one with norms, [d].
using Scale = std::vector<double>;

void ScaleRow(double factor, int k, Tensor* weight) {
  const int inputs = weight->shape[1];
  float* const row = weight->values.data() + static_cast<size_t>(k) * inputs;
  for (int j = 0; j < inputs; ++j) row[j] = static_cast<float>(factor * row[j]);
}

void FoldEmbedding(Embedding* embedding) {
  const Norm norm = std::exchange(embedding->norm, {});
  for (size_t k = 0; k < norm.weight.values.size(); ++k) {
    const double weight = norm.weight.values[k];
    float& bias = embedding->linear.bias.values[k];
    ScaleRow(weight, static_cast<int>(k), &embedding->linear.weight);
    bias = static_cast<float>(weight * bias + norm.bias.values[k]);
  }
}

// With x = scale * z, weight * (x + update) + bias is (weight * scale) * (z + update / scale + bias
// / (weight * scale)).
void FoldUpdate(Norm folded, Linear* update, Scale* scale) {
  for (size_t k = 0; k < scale->size(); ++k) {
    const double weight = folded.weight.values[k];
    const double next =
        (*scale)[k] * std::copysign(std::max(std::abs(weight), kSmallestWeight), weight);
    float& bias = update->bias.values[k];
    ScaleRow(1.0 / (*scale)[k], static_cast<int>(k), &update->weight);
    bias = static_cast<float>(bias / (*scale)[k] + folded.bias.values[k] / next);
    (*scale)[k] = next;
  }
}

void FoldCoder(const Scale& scale, Coder* coder) {
  for (size_t k = 0; k < scale.size(); ++k) {
    coder->gain.values[k] = static_cast<float>(scale[k] * coder->gain.values[k]);
  }
}

// Removes the norms of a policy whose norms stand for x_k <- weight_k x_k + bias_k. The embeddings,
// the maps whose outputs are added to the residual stream, and the gains of the coders change, so
// that every coder gets the same current up to rounding. REQUIRES: a valid policy with norms and
// spikes in float32.
void FoldNorms(Policy* policy) {
  SPIKESERVE_DCHECK(policy->config.has_norms() && !policy->config.is_dense());
  Weights& weights = policy->weights;
  FoldEmbedding(&weights.embed_return);
  FoldEmbedding(&weights.embed_state);
  FoldEmbedding(&weights.embed_action);
  Scale scale(policy->config.hidden_size, 1.0);
  for (LayerWeights& layer : weights.layers) {
    FoldCoder(scale, &layer.coder);
    FoldUpdate(std::exchange(layer.attention_norm, {}), &layer.attention_output, &scale);
    FoldCoder(scale, &layer.ffn_coder);
    FoldUpdate(std::exchange(layer.ffn_norm, {}), &layer.ffn_output, &scale);
  }
  FoldCoder(scale, &weights.readout_coder);
  policy->config.norm = NormKind::kNone;
}

// One forward pass over a batch of clips.
class ForwardPass {
 public:
  // Without `fading`, norms do not fade; see FadingNorms::Normalize for `batch`.
  ForwardPass(const Policy& policy, const Parameters& parameters, const FadingNorms* fading,
              BatchMoments* batch, const Surrogate& surrogate, const ClipTensors& clips)
      : policy_(policy),
        config_(policy.config),
        p_(parameters),
        fading_(fading),
        batch_(batch),
        surrogate_(surrogate),
        lif_{{config_.membrane_decay, config_.threshold}, config_.ticks, surrogate},
        clips_(clips),
        mask_(BandMask(clips.timesteps.size(1), config_.context, clips.timesteps.device())) {}

  ModelOutput Run() {
    torch::Tensor x = Embed();
    if (config_.has_phase()) EmitPhase();
    for (int layer = 0; layer < config_.layers; ++layer) {
      x = config_.is_dense() ? DenseLayer(x, layer) : SpikingLayer(x, layer);
    }
    output_.readout = x;
    if (!config_.is_dense()) {
      output_.readout = Code(x, "readout.coder", Stage::kReadout, -1).mean(0);
    }
    output_.logits = p_.Linear(output_.readout, "head");
    return std::move(output_);
  }

 private:
  bool IsLast(int layer) const { return layer + 1 == config_.layers; }

  // Returns the norm `name` of x, or x itself if the policy has no norms.
  torch::Tensor Norm(const torch::Tensor& x, const std::string& name) const {
    if (!config_.has_norms()) return x;
    return fading_ == nullptr ? p_.Norm(x, name) : fading_->Normalize(p_, x, name, batch_);
  }

  // Returns the embedded tokens, [B, 3n, d].
  torch::Tensor Embed() const {
    const torch::Tensor x =
        torch::stack({EmbedModality(ReturnInput(policy_, clips_), "embed.return"),
                      EmbedModality(StateInput(policy_, p_, clips_), "embed.state"),
                      EmbedModality(clips_.actions, "embed.action")},
                     2);
    return x.flatten(1, 2);
  }

  torch::Tensor EmbedModality(const torch::Tensor& input, const std::string& name) const {
    torch::Tensor x = p_.Linear(input, name);
    if (config_.is_dense()) {
      const torch::Tensor& table = p_["embed.timestep.weight"];
      x = x + table.index({clips_.timesteps.clamp_max(table.size(0) - 1)});
    }
    return Norm(x, name + ".norm");
  }

  // Computes the phase spikes of every timestep and repeats them for its three tokens.
  void EmitPhase() {
    const torch::Tensor spikes = PhaseSpikes(p_["phase.omega"], p_["phase.phi"],
                                             PhaseTimes(config_, clips_.timesteps), surrogate_);
    output_.populations.push_back({Stage::kPhase, -1, spikes, {}});
    phase_ = ForEachToken(spikes, 2);
  }

  // Returns a coder's spikes [T, B, tokens, d] for x [B, tokens, d].
  torch::Tensor Code(const torch::Tensor& x, const std::string& name, Stage stage, int layer) {
    const torch::Tensor current = x * p_[name + ".gain"] + p_[name + ".bias"];
    output_.populations.push_back({stage, layer, LifConstant(current, lif_), current});
    return output_.populations.back().spikes;
  }

  // Returns the spikes [T, B, tokens, neurons] of the population `name` for input spikes [T, B,
  // tokens, in].
  torch::Tensor Fire(const torch::Tensor& input, const std::string& name, Stage stage, int layer) {
    const torch::Tensor current = p_.Linear(input, name);
    output_.populations.push_back({stage, layer, LifPerTick(current, lif_), current});
    return output_.populations.back().spikes;
  }

  // Returns the layer's output, [B, 3n, d]. The last layer computes queries and outputs only for
  // the state tokens and returns [B, n, d].
  torch::Tensor SpikingLayer(const torch::Tensor& x, int layer) {
    const std::string name = absl::StrCat("layers.", layer);
    torch::Tensor coded = Code(x, name + ".coder", Stage::kCoder, layer);
    if (config_.has_phase()) coded = torch::cat({coded, phase_}, -1);
    const torch::Tensor asking = IsLast(layer) ? StateTokens(coded, 2) : coded;
    const std::string attention = name + ".attention";
    const torch::Tensor q = Fire(asking, attention + ".query", Stage::kQuery, layer);
    const torch::Tensor k = Fire(coded, attention + ".key", Stage::kKey, layer);
    const torch::Tensor v = Fire(coded, attention + ".value", Stage::kValue, layer);
    const torch::Tensor y = Attend(q, k, v, p_[attention + ".scale"], Mask(layer), config_.heads);
    return SpikingFeedForward(AddAttention(x, RouteHeads(p_, name, config_, y), attention, layer),
                              name, layer);
  }

  torch::Tensor SpikingFeedForward(const torch::Tensor& x, const std::string& name, int layer) {
    const torch::Tensor coded = Code(x, name + ".ffn.coder", Stage::kFfnIn, layer);
    const torch::Tensor hidden = Fire(coded, name + ".ffn.hidden", Stage::kFfnHidden, layer);
    return Norm(x + p_.Linear(hidden.mean(0), name + ".ffn.output"), name + ".ffn.norm");
  }

  // As SpikingLayer, for a layer of an ordinary decision transformer with the same residual
  // connections.
  torch::Tensor DenseLayer(const torch::Tensor& x, int layer) {
    const std::string name = absl::StrCat("layers.", layer);
    const std::string attention = name + ".attention";
    const torch::Tensor asking = IsLast(layer) ? StateTokens(x, 1) : x;
    const torch::Tensor scale = torch::full({1}, 1.0 / std::sqrt(config_.head_size()), x.options());
    const torch::Tensor y =
        Attend(p_.Linear(asking, attention + ".query"), p_.Linear(x, attention + ".key"),
               p_.Linear(x, attention + ".value"), scale, Mask(layer), config_.heads);
    const torch::Tensor after = AddAttention(x, y.transpose(1, 2).flatten(-2), attention, layer);
    const torch::Tensor hidden = at::gelu(p_.Linear(after, name + ".ffn.hidden"), "tanh");
    return Norm(after + p_.Linear(hidden, name + ".ffn.output"), name + ".ffn.norm");
  }

  // Returns what is added to the scores of a layer: [Q, 3n].
  torch::Tensor Mask(int layer) const { return IsLast(layer) ? StateTokens(mask_, -2) : mask_; }

  // Returns the norm of x + W_O merged + b_O for the tokens that have an output in this layer.
  torch::Tensor AddAttention(const torch::Tensor& x, const torch::Tensor& merged,
                             const std::string& attention, int layer) const {
    const torch::Tensor residual = IsLast(layer) ? StateTokens(x, 1) : x;
    return Norm(residual + p_.Linear(merged, attention + ".output"), attention + ".norm");
  }

  const Policy& policy_;
  const ModelConfig& config_;
  const Parameters& p_;
  const FadingNorms* const fading_;
  BatchMoments* const batch_;
  const Surrogate surrogate_;
  const LifOptions lif_;
  const ClipTensors& clips_;
  const torch::Tensor mask_;  // [3n, 3n]
  torch::Tensor phase_;       // [T, B, 3n, H]
  ModelOutput output_;
};

}  // namespace

absl::StatusOr<Policy> RoundTo(Arithmetic arithmetic, const Policy& policy) {
  if (arithmetic == Arithmetic::kInteger) return QuantizeToInteger(policy);
  return policy;
}

TorchModel::TorchModel(Policy policy, const Surrogate& surrogate, Arithmetic arithmetic,
                       const PatchShape& patches, uint64_t seed, torch::Device device)
    : policy_(std::move(policy)),
      surrogate_(surrogate),
      parameters_(policy_, patches, seed, device),
      arithmetic_(arithmetic) {
  if (arithmetic_ != Arithmetic::kFloat32) SetRounded(*RoundTo(arithmetic_, policy_));
}

void TorchModel::SetRounded(Policy policy) {
  RoundedMaps maps(policy);
  rounded_.emplace(Rounded{std::move(policy), std::move(maps)});
}

ModelOutput TorchModel::Forward(const ClipTensors& clips) const {
  if (arithmetic_ == Arithmetic::kInteger) {
    const ModelConfig& config = policy_.config;
    return ForwardInIntegers(rounded_->policy, rounded_->maps, parameters_,
                             {{config.membrane_decay, config.threshold}, config.ticks, surrogate_},
                             clips);
  }
  return ForwardPass(policy_, parameters_, fading_norms(), nullptr, surrogate_, clips).Run();
}

void TorchModel::FadeNorms() {
  SPIKESERVE_DCHECK(arithmetic_ == Arithmetic::kFloat32);
  fading_norms_.emplace(policy_, parameters_["head.weight"].device());
}

ModelOutput TorchModel::ForwardInTraining(const ClipTensors& clips, const torch::Tensor& mask) {
  if (!fading_norms_.has_value()) return Forward(clips);
  BatchMoments batch = {.mask = mask};
  ModelOutput output =
      ForwardPass(policy_, parameters_, fading_norms(), &batch, surrogate_, clips).Run();
  fading_norms_->Follow(batch);
  return output;
}

absl::Status TorchModel::Round() {
  if (arithmetic_ == Arithmetic::kFloat32) return absl::OkStatus();
  ASSIGN_OR_RETURN(Policy policy, RoundTo(arithmetic_, FloatPolicy()));
  SetRounded(std::move(policy));
  return absl::OkStatus();
}

Policy TorchModel::FloatPolicy() const {
  Policy policy = policy_;
  parameters_.Store(&policy);
  return policy;
}

Policy TorchModel::CurrentPolicy() const {
  if (rounded_.has_value()) return rounded_->policy;
  Policy policy = FloatPolicy();
  if (fading_norms_.has_value()) {
    fading_norms_->MakeAffine(&policy);
    FoldNorms(&policy);
  }
  return policy;
}

}  // namespace spikeserve
