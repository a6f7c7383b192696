#include "core/model/config.h"

#include <cmath>
#include <cstdint>
#include <limits>

#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"

namespace spikeserve {
namespace {

absl::Status CheckRange(absl::string_view field, int value, int limit) {
  if (value >= 1 && value <= limit) return absl::OkStatus();
  return absl::InvalidArgumentError(
      absl::StrCat(field, ": expected 1 to ", limit, ", received ", value));
}

// Checks what only integer policies require.
absl::Status CheckInteger(const ModelConfig& config) {
  if (config.is_dense()) {
    return absl::InvalidArgumentError("arithmetic: expected float32 in mode dense, received int8");
  }
  if (config.integer_decay() > std::numeric_limits<int16_t>::max()) {
    return absl::InvalidArgumentError(
        absl::StrCat("membrane_decay: expected at most 32767/32768 after rounding with arithmetic "
                     "int8, received ",
                     config.membrane_decay));
  }
  return absl::OkStatus();
}

// Checks what only policies in Arithmetic::kInteger require.
absl::Status CheckFixedPoint(const ModelConfig& config) {
  absl::Status status = CheckRange("input_fraction", config.input_fraction, ModelLimits::kFraction);
  status.Update(CheckRange("residual_fraction", config.residual_fraction, ModelLimits::kFraction));
  if (config.is_dense()) {
    if (config.attention == Attention::kShiftmax) return status;
    return absl::InvalidArgumentError(
        "attention: expected shiftmax in mode dense, received linear");
  }
  if (config.coder != CoderKind::kLif) {
    return absl::InvalidArgumentError(
        "coder: expected lif with arithmetic integer, received bernoulli");
  }
  if (config.leak == Leak::kShift && config.leak_shift() == 0) {
    return absl::InvalidArgumentError(
        absl::StrCat("membrane_decay: expected 1 - 2^-k for a k from 1 to 8 with leak shift, "
                     "received ",
                     config.membrane_decay));
  }
  if (config.leak == Leak::kNone && config.membrane_decay != 1.0f) {
    return absl::InvalidArgumentError(absl::StrCat(
        "membrane_decay: expected 1 with leak none, received ", config.membrane_decay));
  }
  status.Update(CheckRange("ticks", config.ticks, ModelLimits::kIntegerTicks));
  const int64_t overlap = int64_t{config.ticks} * config.head_size();
  const int64_t sum = int64_t{3} * config.context * config.ticks * overlap;
  if (config.attention == Attention::kLinear && (overlap > std::numeric_limits<int16_t>::max() ||
                                                 sum > std::numeric_limits<int32_t>::max())) {
    return absl::InvalidArgumentError(
        absl::StrCat("attention: expected shiftmax for overlaps of up to ", overlap,
                     " (ticks hidden_size / heads) and sums of up to ", sum,
                     " (3 context ticks^2 hidden_size / heads), received linear"));
  }
  return status;
}

// Checks that attention is a softmax over the overlaps of spikes, which a bias can be added to.
absl::Status CheckRelativeBias(const ModelConfig& config) {
  if (!config.relative_bias) return absl::OkStatus();
  if (config.is_dense()) {
    return absl::InvalidArgumentError("relative_bias: expected false in mode dense, received true");
  }
  if (config.is_integer() && config.attention == Attention::kLinear) {
    return absl::InvalidArgumentError(
        "relative_bias: expected false with attention linear, received true");
  }
  return absl::OkStatus();
}

}  // namespace

int ModelConfig::leak_shift() const {
  for (int k = 1; k <= 8; ++k) {
    if (membrane_decay == 1.0f - 1.0f / static_cast<float>(1 << k)) return k;
  }
  return 0;
}

int ModelConfig::integer_decay() const {
  return static_cast<int>(std::nearbyint(membrane_decay * 32768.0f));
}

absl::Status ModelConfig::Validate() const {
  absl::Status status;
  status.Update(CheckRange("hidden_size", hidden_size, ModelLimits::kHiddenSize));
  status.Update(CheckRange("heads", heads, ModelLimits::kHeads));
  status.Update(CheckRange("layers", layers, ModelLimits::kLayers));
  status.Update(CheckRange("ticks", ticks, ModelLimits::kTicks));
  status.Update(CheckRange("context", context, ModelLimits::kContext));
  status.Update(
      CheckRange("routing_hidden_size", routing_hidden_size, ModelLimits::kRoutingHiddenSize));
  status.Update(CheckRange("ffn_size", ffn_size, ModelLimits::kFfnSize));
  if (!status.ok()) return status;
  if (hidden_size % heads != 0) {
    return absl::InvalidArgumentError(absl::StrCat(
        "hidden_size: expected a multiple of heads = ", heads, ", received ", hidden_size));
  }
  if (!(membrane_decay >= 0.0f && membrane_decay <= 1.0f)) {
    return absl::InvalidArgumentError(
        absl::StrCat("membrane_decay: expected 0 to 1, received ", membrane_decay));
  }
  if (!(threshold > 0.0f && std::isfinite(threshold))) {
    return absl::InvalidArgumentError(
        absl::StrCat("threshold: expected a positive finite number, received ", threshold));
  }
  if (is_dense() && !has_norms()) {
    return absl::InvalidArgumentError("norm: expected layer in mode dense, received none");
  }
  if (absl::Status valid = CheckRelativeBias(*this); !valid.ok()) return valid;
  if (is_integer()) return CheckFixedPoint(*this);
  return arithmetic == Arithmetic::kInt8 ? CheckInteger(*this) : absl::OkStatus();
}

}  // namespace spikeserve
