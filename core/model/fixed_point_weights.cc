#include "core/model/fixed_point_weights.h"

#include <algorithm>
#include <cstdlib>
#include <limits>
#include <string>

#include "absl/strings/str_cat.h"
#include "core/base/json.h"
#include "core/model/integer_weights.h"

namespace spikeserve {
namespace {

constexpr int kSmallestShift = -15;
constexpr int kLargestShift = 31;
constexpr int kLargestNormShift = 15;
// A residual is added to what a map returns.
constexpr int64_t kLargestSum = std::numeric_limits<int32_t>::max() - kLargestResidual;

// Checks that every number is from `low` to `high`.
absl::Status CheckNumbers(const std::string& name, const auto& tensor, int low, int high) {
  for (size_t i = 0; i < tensor.values.size(); ++i) {
    const int value = tensor.values[i];
    if (value >= low && value <= high) continue;
    return ElementError(name, absl::StrCat(low, " to ", high), value, i);
  }
  return absl::OkStatus();
}

// Checks that no step of the map can leave 32 bits if the magnitudes of its inputs are at most
// `largest_input`.
absl::Status CheckMap(const std::string& name, const FixedPointMap& map, int largest_input) {
  absl::Status status =
      CheckNumbers(name + ".weight", map.weight, -kLargestInt8Weight, kLargestInt8Weight);
  status.Update(CheckNumbers(name + ".shift", map.shift, kSmallestShift, kLargestShift));
  if (!status.ok()) return status;
  for (int k = 0; k < map.weight.shape[0]; ++k) {
    int64_t weights = 0;
    for (int j = 0; j < map.weight.shape[1]; ++j) weights += std::abs(int{map.weight.at(k, j)});
    const int shift = map.shift.values[k];
    const int64_t rounding = shift > 0 ? int64_t{1} << (shift - 1) : 0;
    const int64_t sum = weights * largest_input + rounding;
    const int64_t result = (shift > 0 ? sum >> shift : sum * (int64_t{1} << -shift)) +
                           std::abs(int{map.bias.values[k]});
    if (std::max(sum, result) <= kLargestSum) continue;
    return ElementError(
        name + ".weight",
        absl::StrCat("sums of at most ", kLargestSum, " for inputs of at most ", largest_input),
        std::max(sum, result), k);
  }
  return absl::OkStatus();
}

// Accepts the empty norm of a policy without norms.
absl::Status CheckNorm(const std::string& name, const FixedPointNorm& norm) {
  absl::Status status =
      CheckNumbers(name + ".weight", norm.weight, -kLargestResidual, kLargestResidual);
  status.Update(CheckNumbers(name + ".shift", norm.shift, 0, kLargestNormShift));
  return status;
}

absl::Status CheckCoder(const std::string& name, const PeriodCoder& coder) {
  for (size_t j = 0; j < coder.sign.values.size(); ++j) {
    if (std::abs(int{coder.sign.values[j]}) != 1) {
      return ElementError(name + ".sign", "1 or -1", coder.sign.values[j], j);
    }
  }
  const int ticks = coder.threshold.shape[1];
  for (size_t i = 0; i < coder.threshold.values.size(); ++i) {
    if (i % ticks == 0 || coder.threshold.values[i] <= coder.threshold.values[i - 1]) continue;
    return ElementError(name + ".threshold",
                        absl::StrCat("at most ", coder.threshold.values[i - 1]),
                        coder.threshold.values[i], i);
  }
  return absl::OkStatus();
}

absl::Status CheckEmbedding(const std::string& name, const FixedPointEmbedding& embedding) {
  absl::Status status = CheckMap(name, embedding.linear, kLargestResidual);
  status.Update(CheckNorm(name + ".norm", embedding.norm));
  return status;
}

// The activations of a dense policy have 8 bits and an exponent, and no more than 16 bits together.
absl::Status CheckDenseLayer(absl::string_view name, const FixedPointLayer& layer) {
  const auto part = [name](absl::string_view suffix) { return absl::StrCat(name, suffix); };
  absl::Status status = CheckMap(part(".attention.query"), layer.query, kLargestResidual);
  status.Update(CheckMap(part(".attention.key"), layer.key, kLargestResidual));
  status.Update(CheckMap(part(".attention.value"), layer.value, kLargestResidual));
  status.Update(CheckMap(part(".attention.output"), layer.attention_output, kLargestResidual));
  status.Update(CheckNorm(part(".attention.norm"), layer.attention_norm));
  status.Update(CheckMap(part(".ffn.hidden"), layer.ffn_hidden, kLargestResidual));
  status.Update(CheckMap(part(".ffn.output"), layer.ffn_output, kLargestResidual));
  status.Update(CheckNorm(part(".ffn.norm"), layer.ffn_norm));
  return status;
}

}  // namespace

absl::Status CheckFixedPointLayer(absl::string_view name, const ModelConfig& config,
                                  const FixedPointLayer& layer) {
  if (config.is_dense()) return CheckDenseLayer(name, layer);
  const auto part = [name](absl::string_view suffix) { return absl::StrCat(name, suffix); };
  absl::Status status = CheckCoder(part(".coder"), layer.coder);
  if (config.has_routing()) {
    status.Update(CheckMap(part(".routing.hidden"), layer.routing_hidden, kLargestAttended));
    status.Update(CheckMap(part(".routing.gate"), layer.routing_gate, kLargestResidual));
  }
  status.Update(CheckMap(part(".attention.output"), layer.attention_output, kLargestAttended));
  status.Update(CheckNorm(part(".attention.norm"), layer.attention_norm));
  status.Update(CheckCoder(part(".ffn.coder"), layer.ffn_coder));
  status.Update(CheckMap(part(".ffn.output"), layer.ffn_output, config.ticks));
  status.Update(CheckNorm(part(".ffn.norm"), layer.ffn_norm));
  return status;
}

absl::Status CheckFixedPointEnds(const ModelConfig& config, const FixedPointEnds& ends) {
  absl::Status status = CheckEmbedding("embed.return", ends.embed_return);
  status.Update(CheckEmbedding("embed.state", ends.embed_state));
  status.Update(CheckEmbedding("embed.action", ends.embed_action));
  if (!config.is_dense()) status.Update(CheckCoder("readout.coder", ends.readout_coder));
  return status;
}

}  // namespace spikeserve
