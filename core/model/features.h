// Names the elements of a policy's observations and actions, with their units and ranges.
//
// Plain values and pure functions; thread-safe.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/types/span.h"

namespace spikeserve {

// One element of an observation or of a Box action, or one action of a Discrete space.
struct Feature {
  std::string name;
  // In UCUM's case-sensitive spelling, for example "m/s", "rad", "deg", "N.m", or "1" for a ratio;
  // empty: unknown.
  std::string unit = {};
  std::optional<double> low = std::nullopt;  // in `unit`; absent: unknown or unbounded
  std::optional<double> high = std::nullopt;
  std::string frame = {};  // frame of reference; empty: unknown

  friend bool operator==(const Feature&, const Feature&) = default;
};

// What a policy file says about the robot. All parts may be empty.
struct Features {
  std::vector<Feature> observation;  // [obs]
  std::vector<Feature> action;       // [act]
  std::optional<double> rate_hz;     // decisions per second in the training data
  double rate_tolerance = 0.1;       // largest relative deviation from rate_hz

  bool empty() const { return *this == Features(); }

  // Returns INVALID_ARGUMENT, which names the field, unless each list is empty or has the given
  // length, every name is unique, printable and not empty, and the numbers are finite and ordered.
  absl::Status Validate(int observation_size, int action_size) const;

  friend bool operator==(const Features&, const Features&) = default;
};

// The JSON object {"observation": [{"name": "x", "unit": "m", "low": -1, "high": 1, "frame":
// "map"},
// ...], "action": [...], "rate_hz": 50, "rate_tolerance": 0.1}, in which everything but a name may
// be left out. An element may also be its name alone. INVALID_ARGUMENT names the member.
absl::StatusOr<Features> ParseFeatures(absl::string_view json);
std::string FormatFeatures(const Features& features);

// What a robot says about its elements, in the order in which it sends them.
struct ReceivedNames {
  std::string field;  // "observation" or "action", for errors
  std::vector<std::string> names;
  std::vector<std::string> units;  // one per name, in which empty ones are unknown; or none
};

// Returns INVALID_ARGUMENT unless the names are those of `expected`, in its order or, if
// `in_any_order`, in any. The message names the first difference, the permutation if the names are
// one, and the factor between units that can be converted.
absl::Status CheckNames(absl::Span<const Feature> expected, const ReceivedNames& received,
                        bool in_any_order);

// Returns the factor from `from` to `to`, or nullopt if one is unknown or they measure different
// quantities.
std::optional<double> UnitFactor(absl::string_view from, absl::string_view to);

}  // namespace spikeserve
