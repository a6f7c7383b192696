// Reads policy files whose spike-driven weights have 8 bits (arithmetic "int8"), which releases
// before the integers wrote and served.
//
// All functions are thread-safe.
#pragma once

#include <string>

#include "absl/status/statusor.h"
#include "core/model/policy.h"

namespace spikeserve {

struct ConvertiblePolicy {
  Policy policy;
  bool was_int8 = false;
};

// As ReadPolicyFile(), but also reads a file in int8, as a policy in float32: a weight becomes its
// level times its scale. A neuron fires at the inputs at which it fired before, whose weights are
// scaled so that its threshold becomes that of the config. QuantizeToInteger() gives the levels of
// the file again.
absl::StatusOr<ConvertiblePolicy> ReadConvertiblePolicy(const std::string& path);

}  // namespace spikeserve
