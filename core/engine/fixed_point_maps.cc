#include "core/engine/fixed_point_maps.h"

#include <algorithm>
#include <cstdlib>

#include "core/math/fixed_point.h"

namespace spikeserve {

std::vector<int32_t> ApplyMap(const FixedPointMap& map, const std::vector<int32_t>& input,
                              int exponent) {
  std::vector<int32_t> output;
  output.reserve(map.bias.values.size());
  const int8_t* row = map.weight.values.data();
  for (size_t k = 0; k < map.bias.values.size(); ++k, row += input.size()) {
    int32_t sum = 0;
    for (size_t j = 0; j < input.size(); ++j) sum += row[j] * input[j];
    output.push_back(
        static_cast<int32_t>(RoundShift(sum, map.shift.values[k] - exponent) + map.bias.values[k]));
  }
  return output;
}

void LimitResidual(std::vector<int32_t>& x) {
  for (int32_t& value : x) value = SaturateResidual(value);
}

void NormalizeResidual(const FixedPointNorm& norm, std::vector<int32_t>& x) {
  const auto size = static_cast<int64_t>(x.size());
  LimitResidual(x);
  int64_t sum = 0;
  for (const int32_t value : x) sum += value;
  const auto mean = static_cast<int32_t>(RoundDivide(sum, size));
  uint64_t squares = 0;
  for (int32_t& value : x) {
    value -= mean;
    squares += static_cast<uint64_t>(int64_t{value} * value);
  }
  const InverseRoot root = InverseRootOf(squares);
  for (size_t k = 0; k < x.size(); ++k) {
    const int64_t scaled =
        RoundShift(int64_t{root.Normalise(x[k])} * norm.weight.values[k], norm.shift.values[0]);
    x[k] = SaturateResidual(scaled + norm.bias.values[k]);
  }
}

uint64_t GateScores(const ModelConfig& config, std::vector<int32_t>& scores) {
  if (config.gate == Gate::kSigmoid) {
    for (int32_t& score : scores) {
      const int64_t other = PowerOfTwo(std::abs(int64_t{score}));
      const int64_t own = score >= 0 ? 65536 : other;
      score = static_cast<int32_t>(RoundDivide(own << kGateFraction, 65536 + other));
    }
    return 0;
  }
  const int64_t best = *std::max_element(scores.begin(), scores.end());
  int64_t sum = 0;
  for (int32_t& score : scores) {
    score = PowerOfTwo(best - score);
    sum += score;
  }
  for (int32_t& score : scores) {
    score = static_cast<int32_t>(RoundDivide(int64_t{score} << kGateFraction, sum));
  }
  return scores.size();
}

}  // namespace spikeserve
