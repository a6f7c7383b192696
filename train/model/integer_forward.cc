#include "train/model/integer_forward.h"

#include <cmath>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/contract/dcheck.h"
#include "core/neuron/phase.h"
#include "train/model/attention.h"
#include "train/model/fixed_point_tensors.h"
#include "train/neuron/lif_function.h"
#include "train/neuron/phase_function.h"

namespace spikeserve {
namespace {

// Returns `exact` as float32, with the gradient of `real`.
torch::Tensor StraightThrough(const torch::Tensor& exact, const torch::Tensor& real) {
  return exact.to(torch::kFloat) + (real - real.detach());
}

// A number with a fixed number of fraction bits.
struct Fixed {
  torch::Tensor level;  // the integers: float64, without gradient
  torch::Tensor real;   // what they stand for: float32, with gradient
};

// One forward pass over a batch of clips.
class IntegerPass {
 public:
  IntegerPass(const Policy& policy, const RoundedMaps& maps, const Parameters& parameters,
              const LifOptions& coder, const ClipTensors& clips)
      : policy_(policy),
        config_(policy.config),
        maps_(maps),
        p_(parameters),
        coder_(coder),
        clips_(clips),
        band_(BandMask(clips.timesteps.size(1), config_.context, torch::kCPU) == 0.0) {}

  ModelOutput Run() {
    Fixed x = Embed();
    if (config_.has_phase()) EmitPhase();
    for (int layer = 0; layer < config_.layers; ++layer) x = Layer(x, layer);
    const PeriodCoder& coder = policy_.weights.fixed_point.readout_coder;
    output_.readout = Code(coder, x, "readout.coder", Stage::kReadout, -1).mean(0);
    output_.logits = p_.Linear(output_.readout, "head");
    return std::move(output_);
  }

 private:
  bool IsLast(int layer) const { return layer + 1 == config_.layers; }

  // Returns a number of the residual stream.
  Fixed Residual(torch::Tensor level, const torch::Tensor& real) const {
    const torch::Tensor value = level * std::ldexp(1.0, -config_.residual_fraction);
    return {std::move(level), StraightThrough(value, real)};
  }

  // Returns the embedded tokens, [B, 3n, d].
  Fixed Embed() const {
    const FixedPointEnds& ends = policy_.weights.fixed_point;
    const Fixed tokens[] = {
        EmbedModality(ReturnInput(policy_, clips_), "embed.return", ends.embed_return),
        EmbedModality(StateInput(policy_, p_, clips_), "embed.state", ends.embed_state),
        EmbedModality(clips_.actions, "embed.action", ends.embed_action)};
    const auto interleave = [&tokens](torch::Tensor Fixed::*part) {
      return torch::stack({tokens[0].*part, tokens[1].*part, tokens[2].*part}, 2).flatten(1, 2);
    };
    return {interleave(&Fixed::level), interleave(&Fixed::real)};
  }

  Fixed EmbedModality(const torch::Tensor& input, const std::string& name,
                      const FixedPointEmbedding& embedding) const {
    const torch::Tensor level = RoundInputs(input, config_.input_fraction);
    return Residual(Normalize(embedding.norm, ApplyMap(embedding.linear, level)),
                    p_.Norm(p_.Linear(input, name), name + ".norm"));
  }

  // Computes the phase spikes of every timestep and repeats them for its three tokens.
  void EmitPhase() {
    const torch::Tensor& omega = p_["phase.omega"];
    const torch::Tensor& phi = p_["phase.phi"];
    const torch::Tensor real =
        PhaseSpikes(omega, phi, PhaseTimes(config_, clips_.timesteps), coder_.surrogate);
    torch::Tensor exact = torch::empty(real.sizes());
    auto to = exact.accessor<float, 4>();
    const auto timesteps = clips_.timesteps.accessor<int64_t, 2>();
    for (int k = 0; k < config_.heads; ++k) {
      const IntegerPhase phase =
          MakeIntegerPhase(omega[k].item<float>(), phi[k].item<float>(), config_.ticks,
                           config_.phase_clock == PhaseClock::kWindow);
      for (int tick = 0; tick < config_.ticks; ++tick) {
        for (int64_t i = 0; i < timesteps.size(0); ++i) {
          for (int64_t j = 0; j < timesteps.size(1); ++j) {
            const uint32_t turns = phase.At(timesteps[i][j], static_cast<uint32_t>(tick));
            to[tick][i][j][k] = IntegerPhase::Spike(turns) ? 1.0f : 0.0f;
          }
        }
      }
    }
    const torch::Tensor spikes = StraightThrough(exact, real);
    output_.populations.push_back({Stage::kPhase, -1, spikes, {}});
    phase_ = ForEachToken(spikes, 2);
  }

  // Returns a coder's spikes [T, B, tokens, d].
  torch::Tensor Code(const PeriodCoder& coder, const Fixed& x, const std::string& name, Stage stage,
                     int layer) {
    const torch::Tensor current = x.real * p_[name + ".gain"] + p_[name + ".bias"];
    const torch::Tensor spikes =
        StraightThrough(CodeSpikes(coder, x.level), LifConstant(current, coder_));
    output_.populations.push_back({stage, layer, spikes, {}});
    return spikes;
  }

  // Returns the spikes [T, B, tokens, neurons] of the population `name` for input spikes [T, B,
  // tokens, in].
  torch::Tensor Fire(const torch::Tensor& input, const std::string& name, Stage stage, int layer) {
    const IntegerLifOptions options = {.neuron = ShiftLif{config_.leak_shift()},
                                       .threshold = maps_.threshold(name),
                                       .scale = maps_.scale(name),
                                       .ticks = config_.ticks,
                                       .surrogate = coder_.surrogate,
                                       .bias = maps_.bias(name),
                                       .events = input.detach().amax(-1).contiguous()};
    const torch::Tensor spikes = IntegerLifPerTick(maps_.Current(p_, name, input), options);
    output_.populations.push_back({stage, layer, spikes, {}});
    return spikes;
  }

  // [T, B, tokens, d] -> [B, H, tokens, T d_h]
  torch::Tensor HeadSpikes(const torch::Tensor& spikes) const {
    return spikes.unflatten(-1, {config_.heads, config_.head_size()})
        .permute({1, 3, 2, 0, 4})
        .flatten(-2);
  }

  // Returns y of each token and head, [B, Q, H, d_h], with kGateFraction fraction bits.
  Fixed Attend(const torch::Tensor& q, const torch::Tensor& k, const torch::Tensor& v, int layer) {
    const torch::Tensor asking = HeadSpikes(q);
    // At most T d_h, which float32 holds exactly.
    const torch::Tensor overlaps = torch::matmul(asking, HeadSpikes(k).transpose(-1, -2));
    const torch::Tensor counts =
        v.sum(0).unflatten(-1, {config_.heads, config_.head_size()}).transpose(1, 2);
    const torch::Tensor band = IsLast(layer) ? StateTokens(band_, 0) : band_;
    const FixedPointLayer& weights = policy_.weights.layers[layer].fixed_point;
    HeadInputs inputs = {.overlaps = overlaps.detach().to(torch::kDouble),
                         .fires = asking.detach().amax(-1, true) > 0.0,
                         .values = counts.detach().to(torch::kDouble),
                         .band = band,
                         .biases = {}};
    if (config_.relative_bias) inputs.biases = Biases(Numbers(weights.attention_relative), layer);
    const torch::Tensor level = AttendInIntegers(inputs, weights.attention_scale, config_);
    const torch::Tensor real =
        torch::matmul(Weights(overlaps, band, layer), counts / config_.ticks);
    return {level.transpose(1, 2),
            StraightThrough(level * std::ldexp(1.0, -kGateFraction), real).transpose(1, 2)};
  }

  // Returns the biases of the scores of a layer from those by distance, [H, Q, S].
  torch::Tensor Biases(const torch::Tensor& relative, int layer) const {
    const torch::Tensor biases = RelativeBiases(relative, band_.size(-1));
    return IsLast(layer) ? StateTokens(biases, 1) : biases;
  }

  // Returns the weights of the tokens from which the gradient comes, [B, H, Q, S].
  torch::Tensor Weights(const torch::Tensor& overlaps, const torch::Tensor& band, int layer) const {
    const torch::Tensor& scale = p_[absl::StrCat("layers.", layer, ".attention.scale")];
    torch::Tensor scores = overlaps * scale.view({-1, 1, 1}) / config_.ticks;
    if (config_.relative_bias) {
      scores = scores + Biases(p_[absl::StrCat("layers.", layer, ".attention.relative")], layer);
    }
    return torch::softmax(scores.masked_fill(band.logical_not(), -1e9), -1);
  }

  // Returns the layer's output, [B, 3n, d]. The last layer computes queries and outputs only for
  // the state tokens and returns [B, n, d].
  Fixed Layer(const Fixed& x, int layer) {
    const std::string name = absl::StrCat("layers.", layer);
    const FixedPointLayer& weights = policy_.weights.layers[layer].fixed_point;
    torch::Tensor coded = Code(weights.coder, x, name + ".coder", Stage::kCoder, layer);
    if (config_.has_phase()) coded = torch::cat({coded, phase_}, -1);
    const torch::Tensor asking = IsLast(layer) ? StateTokens(coded, 2) : coded;
    const std::string attention = name + ".attention";
    const torch::Tensor q = Fire(asking, attention + ".query", Stage::kQuery, layer);
    const torch::Tensor k = Fire(coded, attention + ".key", Stage::kKey, layer);
    const torch::Tensor v = Fire(coded, attention + ".value", Stage::kValue, layer);
    const Fixed y = Attend(q, k, v, layer);
    const torch::Tensor merged = RouteHeads(p_, name, config_, y.real.transpose(1, 2).unsqueeze(0));
    const torch::Tensor merged_level = MergeInIntegers(weights, config_, y.level);
    const Fixed residual =
        IsLast(layer) ? Fixed{StateTokens(x.level, 1), StateTokens(x.real, 1)} : x;
    const Fixed attended =
        Add(residual, ApplyMap(weights.attention_output, merged_level),
            p_.Linear(StraightThrough(merged_level * std::ldexp(1.0, -kGateFraction), merged),
                      attention + ".output"),
            weights.attention_norm, attention + ".norm");
    return FeedForward(attended, name, layer);
  }

  Fixed FeedForward(const Fixed& x, const std::string& name, int layer) {
    const FixedPointLayer& weights = policy_.weights.layers[layer].fixed_point;
    const torch::Tensor coded =
        Code(weights.ffn_coder, x, name + ".ffn.coder", Stage::kFfnIn, layer);
    const torch::Tensor hidden = Fire(coded, name + ".ffn.hidden", Stage::kFfnHidden, layer);
    const torch::Tensor counts = hidden.detach().sum(0).to(torch::kDouble);
    return Add(x, ApplyMap(weights.ffn_output, counts),
               p_.Linear(hidden.mean(0), name + ".ffn.output"), weights.ffn_norm,
               name + ".ffn.norm");
  }

  // Returns the norm `name` of the sum of the residual x and an update.
  Fixed Add(const Fixed& x, const torch::Tensor& update_level, const torch::Tensor& update,
            const FixedPointNorm& norm, const std::string& name) const {
    return Residual(Normalize(norm, x.level + update_level), p_.Norm(x.real + update, name));
  }

  const Policy& policy_;
  const ModelConfig& config_;
  const RoundedMaps& maps_;
  const Parameters& p_;
  const LifOptions coder_;
  const ClipTensors& clips_;
  const torch::Tensor band_;  // whether token i attends to token j: [3n, 3n], bool
  torch::Tensor phase_;       // [T, B, 3n, H]
  ModelOutput output_;
};

}  // namespace

ModelOutput ForwardInIntegers(const Policy& rounded, const RoundedMaps& maps,
                              const Parameters& parameters, const LifOptions& coder,
                              const ClipTensors& clips) {
  SPIKESERVE_DCHECK(!rounded.config.is_dense() && rounded.config.has_norms());
  return IntegerPass(rounded, maps, parameters, coder, clips).Run();
}

}  // namespace spikeserve
