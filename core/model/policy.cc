#include "core/model/policy.h"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <variant>

#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "core/base/json.h"
#include "core/base/printable.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "core/math/counter_random.h"
#include "core/model/wiring_model.h"

namespace spikeserve {
namespace {

std::string ShapeText(const std::vector<int>& shape) {
  const auto append_length = [](std::string* out, int length) {
    absl::StrAppend(out, length < 0 ? "any" : absl::StrCat(length));
  };
  return absl::StrCat("[", absl::StrJoin(shape, ", ", append_length), "]");
}

bool HasShape(const auto& tensor, const std::vector<int>& expected) {
  if (tensor.shape.size() != expected.size()) return false;
  size_t size = 1;
  for (size_t i = 0; i < expected.size(); ++i) {
    const int length = tensor.shape[i];
    if (expected[i] < 0 ? length < 1 : length != expected[i]) return false;
    size *= static_cast<size_t>(length);
  }
  return tensor.values.size() == size;
}

absl::Status CheckShape(const TensorSlot& slot, const auto& tensor) {
  if (HasShape(tensor, slot.shape)) return absl::OkStatus();
  return InvalidArgument(
      absl::StrCat("tensor ", Quoted(slot.name)), absl::StrCat("shape ", ShapeText(slot.shape)),
      absl::StrCat(ShapeText(tensor.shape), " with ", tensor.values.size(), " values"));
}

absl::Status CheckAllFinite(const TensorSlot& slot, const Tensor& tensor) {
  for (size_t i = 0; i < tensor.values.size(); ++i) {
    if (std::isfinite(tensor.values[i])) continue;
    return InvalidArgument(absl::StrCat("tensor ", Quoted(slot.name)), "finite numbers",
                           absl::StrCat(tensor.values[i], " at index ", i));
  }
  return absl::OkStatus();
}

absl::Status CheckTensor(const TensorSlot& slot) {
  absl::Status status =
      std::visit([&](const auto* tensor) { return CheckShape(slot, *tensor); }, slot.tensor);
  if (!status.ok() || !std::holds_alternative<Tensor*>(slot.tensor)) return status;
  return CheckAllFinite(slot, *slot.floats());
}

absl::Status CheckFinite(absl::string_view field, float value) {
  if (std::isfinite(value)) return absl::OkStatus();
  return InvalidArgument(field, "a finite number", value);
}

absl::Status CheckPositive(absl::string_view field, float value) {
  if (value > 0.0f && std::isfinite(value)) return absl::OkStatus();
  return InvalidArgument(field, "a positive finite number", value);
}

absl::Status CheckScales(absl::string_view name, const Tensor& scales) {
  for (size_t i = 0; i < scales.values.size(); ++i) {
    RETURN_IF_ERROR(CheckPositive(
        absl::StrCat("tensor ", Quoted(std::string(name)), " at index ", i), scales.values[i]));
  }
  return absl::OkStatus();
}

absl::Status CheckScalars(const Policy& policy) {
  absl::Status status = CheckFinite("return_offset", policy.return_offset);
  status.Update(CheckPositive("return_scale", policy.return_scale));
  status.Update(CheckFinite("target_return", policy.target_return));
  status.Update(CheckFinite("modulator_mean", policy.modulator_mean));
  status.Update(CheckPositive("modulator_std", policy.modulator_std));
  status.Update(ParseJsonObject("training", policy.training).status());
  if (!IsPrintable(policy.environment)) {  // terminals and sources of C show it
    status.Update(
        InvalidArgument("environment", "printable characters", Quoted(policy.environment)));
  }
  return status;
}

// Checks the ranges of the integers, if the arithmetic has any.
absl::Status CheckIntegers(const ModelConfig& config, const Weights& weights) {
  if (!config.is_integer()) return absl::OkStatus();
  absl::Status status = CheckFixedPointEnds(config, weights.fixed_point);
  for (size_t i = 0; i < weights.layers.size() && status.ok(); ++i) {
    const LayerWeights& layer = weights.layers[i];
    const std::string name = absl::StrCat("layers.", i);
    if (!config.is_dense()) status.Update(CheckIntegerMaps(name, layer.integer));
    status.Update(CheckFixedPointLayer(name, config, layer.fixed_point));
  }
  return status;
}

absl::Status CheckWeights(const Policy& policy) {
  const Weights& weights = policy.weights;
  if (weights.layers.size() != static_cast<size_t>(policy.config.layers)) {
    return InvalidArgument("layers", policy.config.layers,
                           absl::StrCat("weights of ", weights.layers.size()));
  }
  if (policy.observation_size() < 1) {
    return InvalidArgument("tensor \"observation.mean\"", "at least one value", "0");
  }
  // The const_cast is safe: this loop only reads the slots, and TensorSlots resizes nothing,
  // because the number of layers was checked above.
  for (const TensorSlot& slot :
       TensorSlots(policy.config, policy.observation_size(), policy.action_space.size(),
                   const_cast<Weights*>(&weights))) {
    RETURN_IF_ERROR(CheckTensor(slot));
  }
  absl::Status scales = CheckScales("observation.std", weights.observation_std);
  scales.Update(CheckScales("observation.change_std", weights.observation_change_std));
  if (!scales.ok()) return scales;
  return CheckIntegers(policy.config, weights);
}

absl::Status CheckDescription(const Policy& policy) {
  const int size = policy.observation_size();
  RETURN_IF_ERROR(policy.features.Validate(size, policy.action_space.size()));
  if (policy.wiring == nullptr) return absl::OkStatus();
  return policy.wiring->Validate(size, policy.action_space.size());
}

// Generates the random numbers of one tensor. Number i is a function of the seed, the tensor's name
// and i in integer arithmetic, so it depends neither on the C library nor on the order of the
// tensors.
class TensorRandom {
 public:
  TensorRandom(uint64_t seed, absl::string_view name) {
    stream_ = MixBits(seed);
    for (const char c : name) stream_ = RandomBits({stream_, static_cast<unsigned char>(c)});
  }

  // Returns a number that is uniform in [low, high).
  float Uniform(uint64_t i, double low, double high) const {
    return static_cast<float>(low + (high - low) * UniformDouble(RandomBits({stream_, i})));
  }

  // Returns a normally distributed number with mean 0, as the sum of twelve 16-bit uniform numbers
  // (variance 1/12 each). Uses neither logarithm nor cosine; the result stays within six
  // deviations.
  float Normal(uint64_t i, double deviation) const {
    uint64_t sum = 0;
    for (uint64_t word = 0; word < 3; ++word) {
      const uint64_t bits = RandomBits({stream_, i, word});
      sum += (bits & 0xffff) + ((bits >> 16) & 0xffff) + ((bits >> 32) & 0xffff) + (bits >> 48);
    }
    return static_cast<float>(deviation * ((static_cast<double>(sum) + 6.0) / 65536.0 - 6.0));
  }

 private:
  uint64_t stream_;
};

void Fill(Tensor* tensor, float value) {
  std::fill(tensor->values.begin(), tensor->values.end(), value);
}

void FillUniform(const TensorRandom& random, double low, double high, Tensor* tensor) {
  for (size_t i = 0; i < tensor->values.size(); ++i) {
    tensor->values[i] = random.Uniform(i, low, high);
  }
}

// Returns whether the tensor belongs to a projection whose outputs are currents into LIF neurons.
bool FeedsNeurons(const ModelConfig& config, absl::string_view name) {
  if (config.is_dense()) return false;
  return absl::StrContains(name, ".query.") || absl::StrContains(name, ".key.") ||
         absl::StrContains(name, ".value.") || absl::StrContains(name, ".ffn.hidden.");
}

// Fills one tensor with its initial values (see RandomPolicy). `fan_in` is the number of inputs of
// the linear map that the tensor belongs to.
void Initialise(const ModelConfig& config, uint64_t seed, int fan_in, const TensorSlot& slot) {
  const std::string& name = slot.name;
  Tensor* const tensor = slot.floats();
  const TensorRandom random(seed, name);
  const bool is_bias = absl::EndsWith(name, ".bias");
  const double bound = 1.0 / std::sqrt(static_cast<double>(fan_in));
  if (absl::StrContains(name, "norm.")) {
    Fill(tensor, is_bias ? 0.0f : 1.0f);
  } else if (absl::StrContains(name, "coder.")) {
    Fill(tensor, is_bias ? 0.2f : 0.5f);
  } else if (absl::EndsWith(name, ".scale")) {
    Fill(tensor, static_cast<float>(1.0 / std::sqrt(static_cast<double>(config.head_size()))));
  } else if (name == "phase.omega") {
    FillUniform(random, 0.1, 10.0, tensor);
  } else if (name == "phase.phi") {
    FillUniform(random, 0.0, 2.0 * std::numbers::pi, tensor);
  } else if (absl::StartsWith(name, "observation.")) {
    Fill(tensor, name == "observation.mean" ? 0.0f : 1.0f);
  } else if (FeedsNeurons(config, name) && is_bias) {
    Fill(tensor, 0.1f);
  } else if (FeedsNeurons(config, name)) {
    for (size_t i = 0; i < tensor->values.size(); ++i) {
      tensor->values[i] = random.Normal(i, 0.3 * bound);
    }
  } else {
    FillUniform(random, -bound, bound, tensor);
  }
}

}  // namespace

absl::Status Policy::Validate() const {
  absl::Status status = config.Validate();
  status.Update(action_space.Validate());
  status.Update(CheckScalars(*this));
  if (!status.ok()) return status;
  RETURN_IF_ERROR(CheckWeights(*this));
  return CheckDescription(*this);
}

Policy RandomPolicy(const ModelConfig& config, int observation_size,
                    const ActionSpace& action_space, uint64_t seed) {
  SPIKESERVE_DCHECK(config.arithmetic == Arithmetic::kFloat32);
  SPIKESERVE_DCHECK(action_space.Validate().ok());
  SPIKESERVE_DCHECK_GE(observation_size, 1);
  Policy policy;
  policy.config = config;
  policy.action_space = action_space;
  int fan_in = 1;
  for (TensorSlot& slot :
       TensorSlots(config, observation_size, action_space.size(), &policy.weights)) {
    for (int& length : slot.shape) {
      if (length < 0) length = kDenseTimesteps;
    }
    *slot.floats() = Tensor::Zeros(slot.shape);
    if (slot.shape.size() == 2) fan_in = slot.shape[1];  // a bias comes right after its weight
    Initialise(config, seed, fan_in, slot);
  }
  return policy;
}

std::optional<double> TrainingReturn(const Policy& policy) {
  const absl::StatusOr<nlohmann::json> training = ParseJsonObject("training", policy.training);
  if (!training.ok()) return std::nullopt;
  const nlohmann::json::json_pointer path("/evaluation/mean_return");
  if (!training->contains(path) || !training->at(path).is_number()) return std::nullopt;
  return training->at(path).get<double>();
}

}  // namespace spikeserve
