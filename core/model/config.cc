#include "core/model/config.h"

#include <cmath>

#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "core/base/status.h"

namespace spikeserve {
namespace {

absl::Status CheckRange(absl::string_view field, int value, int limit) {
  if (value >= 1 && value <= limit) return absl::OkStatus();
  return InvalidArgument(field, absl::StrCat("1 to ", limit), value);
}

// Checks what only policies in Arithmetic::kInteger require.
absl::Status CheckInteger(const ModelConfig& config) {
  absl::Status status = CheckRange("input_fraction", config.input_fraction, ModelLimits::kFraction);
  status.Update(CheckRange("residual_fraction", config.residual_fraction, ModelLimits::kFraction));
  if (config.is_dense()) return status;
  if (config.leak() == 0) {
    return InvalidArgument("membrane_decay", "1 - m / 256 for an m from 1 to 128 in integers",
                           config.membrane_decay);
  }
  status.Update(CheckRange("ticks", config.ticks, ModelLimits::kIntegerTicks));
  if (config.attention == AttentionTicks::kAllTicks && config.has_routing() &&
      config.merge == Merge::kConcat && config.gate == Gate::kSigmoid) {
    return InvalidArgument(
        "attention", "shiftmax_by_tick with concatenated heads and sigmoid gates",
        "shiftmax, which multiplied these gates by the heads; quantize the float32 policy again");
  }
  return status;
}

}  // namespace

int ModelConfig::leak() const {
  const float leak = (1.0f - membrane_decay) * 256.0f;
  return leak >= 1.0f && leak <= 128.0f && leak == std::floor(leak) ? static_cast<int>(leak) : 0;
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
    return InvalidArgument("hidden_size", absl::StrCat("a multiple of heads = ", heads),
                           hidden_size);
  }
  if (!(membrane_decay >= 0.0f && membrane_decay <= 1.0f)) {
    return InvalidArgument("membrane_decay", "0 to 1", membrane_decay);
  }
  if (!(threshold > 0.0f && std::isfinite(threshold))) {
    return InvalidArgument("threshold", "a positive finite number", threshold);
  }
  if (is_dense() && !has_norms()) {
    return InvalidArgument("norm", "layer in mode dense", "none");
  }
  return is_integer() ? CheckInteger(*this) : absl::OkStatus();
}

}  // namespace spikeserve
