#include "train/model/fixed_point_tensors.h"

#include <ATen/Parallel.h>
#include <ATen/ops/linear.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "core/contract/dcheck.h"
#include "core/engine/fixed_point_maps.h"

namespace spikeserve {
namespace {

constexpr int64_t kRowsPerTask = 64;

// RoundShift, whose `factor` is 2^-shift. A product with a power of two is exact.
torch::Tensor RoundScaled(const torch::Tensor& x, const torch::Tensor& factor) {
  return torch::floor(x * factor + 0.5);
}
torch::Tensor RoundScaled(const torch::Tensor& x, double factor) {
  return torch::floor(x * factor + 0.5);
}

// RoundDivide, for quotients of integers below 2^52, which float64 does not round up to the next
// integer.
torch::Tensor RoundQuotient(const torch::Tensor& a, const torch::Tensor& b) {
  return torch::floor((2.0 * a + b) / (2.0 * b));
}

// Calls `function(row)`, which changes a vector of integers, for each row of x.
template <class Function>
torch::Tensor ForEachRow(const torch::Tensor& x, Function function) {
  torch::Tensor result = x.clone(torch::MemoryFormat::Contiguous);
  const int64_t width = x.size(-1);
  double* const data = result.data_ptr<double>();
  at::parallel_for(0, result.numel() / width, kRowsPerTask, [&](int64_t begin, int64_t end) {
    std::vector<int32_t> row(width);
    for (double* first = data + begin * width; first != data + end * width; first += width) {
      for (int64_t k = 0; k < width; ++k) row[k] = static_cast<int32_t>(first[k]);
      function(row);
      std::copy(row.begin(), row.end(), first);
    }
  });
  return result;
}

// Returns the weights of shiftmax [B, H, Q, S] before the band is applied.
torch::Tensor ShiftmaxWeights(const HeadInputs& inputs, const torch::Tensor& scale) {
  constexpr double kOutside = -1e15;  // less than any score
  torch::Tensor scores = inputs.overlaps * scale;
  if (inputs.biases.defined()) scores = scores + inputs.biases;
  const torch::Tensor best = scores.masked_fill(inputs.band.logical_not(), kOutside).amax(-1, true);
  const torch::Tensor octaves = RoundScaled(best - scores, std::ldexp(1.0, -kScaleFraction));
  // 2^8 / 2^e for e from 0 to 8, and 0 from 9 on.
  std::vector<double> powers;
  for (int e = 0; e <= 8; ++e) powers.push_back(256 >> e);
  powers.push_back(0.0);
  return torch::tensor(powers, torch::kDouble).index({octaves.clamp(0.0, 9.0).to(torch::kLong)});
}

}  // namespace

torch::Tensor RoundInputs(const torch::Tensor& inputs, int fraction) {
  const torch::Tensor scaled = inputs * std::ldexp(1.0f, fraction);
  return scaled.clamp(-kLargestResidual, kLargestResidual).round().to(torch::kDouble);
}

torch::Tensor ApplyMap(const FixedPointMap& map, const torch::Tensor& x) {
  torch::Tensor factor =
      torch::empty({static_cast<int64_t>(map.shift.values.size())}, torch::kDouble);
  std::transform(map.shift.values.begin(), map.shift.values.end(), factor.data_ptr<double>(),
                 [](int8_t shift) { return std::ldexp(1.0, -shift); });
  return RoundScaled(at::linear(x, Numbers(map.weight)), factor) + Numbers(map.bias);
}

torch::Tensor Normalize(const FixedPointNorm& norm, const torch::Tensor& x) {
  return ForEachRow(x, [&norm](std::vector<int32_t>& row) { NormalizeResidual(norm, row); });
}

torch::Tensor CodeSpikes(const PeriodCoder& coder, const torch::Tensor& x) {
  const torch::Tensor thresholds = Numbers(coder.threshold);
  const torch::Tensor signed_x = x * Numbers(coder.sign);
  // Thresholds never increase with the period, so the first one that is passed is found by
  // counting.
  const torch::Tensor period = (signed_x.unsqueeze(-1) <= thresholds).sum(-1) + 1;
  std::vector<int64_t> by_tick(x.dim() + 1, 1);
  by_tick[0] = thresholds.size(1);
  const torch::Tensor tick = torch::arange(1, thresholds.size(1) + 1).view(by_tick);
  return (tick.remainder(period) == 0).to(torch::kFloat);
}

torch::Tensor AttendInIntegers(const HeadInputs& inputs, const Int16Tensor& scale,
                               const ModelConfig& config) {
  const torch::Tensor shiftmax = ShiftmaxWeights(inputs, Numbers(scale).view({-1, 1, 1}));
  const bool weighs_all = inputs.biases.defined();
  const torch::Tensor weights =
      (weighs_all ? shiftmax : torch::where(inputs.fires, shiftmax, torch::ones_like(shiftmax))) *
      inputs.band;
  const torch::Tensor attended = torch::matmul(weights, inputs.values);
  return RoundQuotient(attended * std::ldexp(1.0, kGateFraction),
                       weights.sum(-1, true) * config.ticks)
      .clamp_max(kLargestAttended);
}

torch::Tensor MergeInIntegers(const FixedPointLayer& layer, const ModelConfig& config,
                              const torch::Tensor& y) {
  const double unit = std::ldexp(1.0, -kGateFraction);
  const bool concat = config.merge == Merge::kConcat;
  torch::Tensor merged = concat ? y.flatten(-2) : y.sum(-2);
  if (config.has_routing()) {
    const torch::Tensor hidden =
        ApplyMap(layer.routing_hidden, y.flatten(-2)).clamp(0, kLargestResidual);
    const torch::Tensor gates =
        ForEachRow(ApplyMap(layer.routing_gate, hidden),
                   [&config](std::vector<int32_t>& row) { GateScores(config, row); });
    const torch::Tensor gated = gates.unsqueeze(-1) * y;
    // The gates of concatenated heads are multiplied by H, so that uniform gates are 1.
    merged = RoundScaled(concat ? gated.flatten(-2) * config.heads : gated.sum(-2), unit);
  } else if (!concat) {
    merged = RoundQuotient(merged, torch::full({1}, config.heads, torch::kDouble));
  }
  return merged.clamp_max(kLargestAttended);
}

}  // namespace spikeserve
