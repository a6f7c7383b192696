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

// [T, B, S, d] -> [T, B, H, S, d_h]
torch::Tensor SplitHeads(const torch::Tensor& spikes, const ModelConfig& config) {
  return spikes.to(torch::kDouble)
      .unflatten(-1, {config.heads, config.head_size()})
      .transpose(-2, -3);
}

// Returns the weights of shiftmax [T, B, H, Q, S] for the overlaps, before the band is applied.
torch::Tensor ShiftmaxWeights(const HeadInputs& inputs, const torch::Tensor& overlaps,
                              const torch::Tensor& scale) {
  constexpr double kOutside = -1e15;  // less than any score
  const torch::Tensor scores = overlaps * scale;
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
  SPIKESERVE_DCHECK(config.attention == AttentionTicks::kByTick);
  const torch::Tensor query = SplitHeads(inputs.query, config);
  const torch::Tensor overlaps =
      torch::matmul(query, SplitHeads(inputs.key, config).transpose(-1, -2));
  torch::Tensor weights = ShiftmaxWeights(inputs, overlaps, Numbers(scale).view({-1, 1, 1}));
  const torch::Tensor fires = query.amax(-1, true) > 0.0;  // [T, B, H, Q, 1]
  weights = torch::where(fires, weights, torch::ones_like(weights));
  weights = weights * inputs.band;
  torch::Tensor sums = torch::matmul(weights, SplitHeads(inputs.value, config));
  torch::Tensor totals = weights.sum(-1, true);
  // The ticks without a query spike are one group.
  const torch::Tensor silent = fires.any(2, true).logical_not();
  const auto group = [&silent](const torch::Tensor& x) {
    return torch::where(silent, (x * silent).sum(0, true), x);
  };
  return RoundQuotient(group(sums) * std::ldexp(1.0, kGateFraction), group(totals))
      .clamp_max(kLargestAttended);
}

torch::Tensor MergeInIntegers(const FixedPointLayer& layer, const ModelConfig& config,
                              const torch::Tensor& y) {
  const bool concat = config.merge == Merge::kConcat;
  torch::Tensor heads = y.transpose(2, 3);  // [T, B, Q, H, d_h]
  double unit = concat ? 1.0 : config.heads;
  if (config.has_routing()) {
    const torch::Tensor hidden =
        ApplyMap(layer.routing_hidden, heads.flatten(-2)).clamp(0, kLargestResidual);
    const torch::Tensor gates =
        ForEachRow(ApplyMap(layer.routing_gate, hidden),
                   [&config](std::vector<int32_t>& row) { GateScores(config, row); });
    heads = gates.unsqueeze(-1) * heads * config.gate_factor();
    unit = std::ldexp(1.0, kGateFraction);
  }
  const torch::Tensor sums =
      concat ? heads.sum(0).flatten(-2) : heads.sum(std::vector<int64_t>{0, 3});
  return RoundQuotient(sums, torch::full({1}, unit * config.ticks, torch::kDouble))
      .clamp_max(kLargestAttended);
}

}  // namespace spikeserve
