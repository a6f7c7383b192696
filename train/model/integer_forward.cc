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
        mask_(BandMask(clips.timesteps.size(1), config_.context, torch::kCPU)) {}

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
    const IntegerLifOptions options = {.neuron = ShiftLif{config_.leak()},
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

  // Returns y of each tick, token and head, [T, B, H, Q, d_h], with kGateFraction fraction bits.
  Fixed AttendHeads(const torch::Tensor& q, const torch::Tensor& k, const torch::Tensor& v,
                    int layer) {
    const std::string attention = absl::StrCat("layers.", layer, ".attention");
    const FixedPointLayer& weights = policy_.weights.layers[layer].fixed_point;
    const torch::Tensor mask = IsLast(layer) ? StateTokens(mask_, -2) : mask_;
    const HeadInputs inputs = {
        .query = q.detach(), .key = k.detach(), .value = v.detach(), .band = mask == 0.0};
    const torch::Tensor level = AttendInIntegers(inputs, weights.attention_scale, config_);
    const torch::Tensor real = Attend(q, k, v, p_[attention + ".scale"], mask, config_.heads);
    return {level, StraightThrough(level * std::ldexp(1.0, -kGateFraction), real)};
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
    const Fixed y = AttendHeads(q, k, v, layer);
    const torch::Tensor merged = RouteHeads(p_, name, config_, y.real);
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
  const torch::Tensor mask_;  // see BandMask, [3n, 3n]
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
