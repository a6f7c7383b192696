#include "core/model/integer_weights.h"

#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <string>

#include "absl/strings/str_cat.h"
#include "core/base/json.h"
#include "core/base/status.h"

namespace spikeserve {
namespace {

absl::Status CheckWeights(const std::string& name, const Int8Tensor& weight) {
  for (size_t i = 0; i < weight.values.size(); ++i) {
    const int value = weight.values[i];
    if (std::abs(value) > kLargestInt8Weight) {
      return ElementError(name, "-127 to 127", value, i);
    }
  }
  return absl::OkStatus();
}

absl::Status CheckScale(const std::string& name, const Tensor& scale) {
  for (size_t i = 0; i < scale.values.size(); ++i) {
    if (!(scale.values[i] > 0.0f && std::isfinite(scale.values[i]))) {
      return ElementError(name, "positive finite numbers", scale.values[i], i);
    }
  }
  return absl::OkStatus();
}

absl::Status CheckThreshold(const std::string& name, const Int16Tensor& threshold) {
  for (size_t i = 0; i < threshold.values.size(); ++i) {
    if (threshold.values[i] < 1) {
      return ElementError(name, "1 to 32767", int{threshold.values[i]}, i);
    }
  }
  return absl::OkStatus();
}

// Checks that no current into the population can leave 16 bits.
absl::Status CheckCurrents(const std::string& name, const IntegerPopulation& population) {
  const int outputs = population.weight.shape[0];
  const int inputs = population.weight.shape[1];
  for (int k = 0; k < outputs; ++k) {
    int current = std::abs(int{population.bias.values[k]});
    for (int j = 0; j < inputs; ++j) current += std::abs(int{population.weight.at(k, j)});
    if (current > kLargestCurrent) {
      return ElementError(name + ".weight",
                          absl::StrCat("|bias| + sum of |weight| of at most ", kLargestCurrent),
                          current, k);
    }
  }
  return absl::OkStatus();
}

absl::Status CheckPopulation(const std::string& name, const IntegerPopulation& population) {
  absl::Status status = CheckWeights(name + ".weight", population.weight);
  status.Update(CheckScale(name + ".scale", population.scale));
  status.Update(CheckThreshold(name + ".threshold", population.threshold));
  status.Update(CheckCurrents(name, population));
  return status;
}

}  // namespace

absl::Status ElementError(absl::string_view tensor, absl::string_view expected,
                          const absl::AlphaNum& received, size_t index) {
  return InvalidArgument(absl::StrCat("tensor ", Quoted(tensor)), expected,
                         absl::StrCat(received, " at index ", index));
}

absl::Status CheckIntegerMaps(absl::string_view name, const IntegerMaps& maps) {
  absl::Status status = CheckPopulation(absl::StrCat(name, ".attention.query"), maps.query);
  status.Update(CheckPopulation(absl::StrCat(name, ".attention.key"), maps.key));
  status.Update(CheckPopulation(absl::StrCat(name, ".attention.value"), maps.value));
  status.Update(CheckPopulation(absl::StrCat(name, ".ffn.hidden"), maps.ffn_hidden));
  return status;
}

}  // namespace spikeserve
