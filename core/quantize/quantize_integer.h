// Converts a float32 policy to integer arithmetic (Arithmetic::kInteger).
//
//   absl::StatusOr<Policy> integer = QuantizeToInteger(policy, {.mode = Mode::kBaseline});
//
// All functions are pure and thread-safe.
#pragma once

#include <optional>

#include "absl/status/statusor.h"
#include "core/model/policy.h"

namespace spikeserve {

struct IntegerOptions {
  std::optional<Mode> mode =
      {};  // leaves out the parts that this mode lacks; absent: the policy's mode
  // The largest magnitude of a standardised input that must not saturate. A calibration set gives
  // it.
  float largest_input = 32.0f;
  // Of a policy without norms: the largest magnitude of its residual stream that must not saturate.
  // A calibration set gives it, too.
  float largest_residual = 16.0f;
};

// Returns `policy` in integer arithmetic. docs/design/integer.md defines every rounding. The action
// head, the standardisation of observations and the phase generators stay as they are.
//
// INVALID_ARGUMENT if `policy` is not valid, is not float32, lacks a part that options.mode has, or
// has numbers that the integers cannot hold. The message names the tensor or field.
absl::StatusOr<Policy> QuantizeToInteger(const Policy& policy, const IntegerOptions& options = {});

}  // namespace spikeserve
