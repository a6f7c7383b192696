#include "core/action/action_space.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <string>

#include "absl/strings/str_cat.h"
#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

// Returns the shortest text that is this number and no other one.
std::string Shortest(float number) {
  char text[32];
  return {text, std::to_chars(text, text + sizeof(text), number).ptr};
}

}  // namespace

// Encode and FromUnit compute in double, because high - low can overflow float32.
void ActionSpace::Encode(const Action& action, absl::Span<float> encoded) const {
  SPIKESERVE_DCHECK(Contains(action).ok());
  SPIKESERVE_DCHECK_EQ(encoded.size(), static_cast<size_t>(size()));
  if (is_discrete()) {
    std::fill(encoded.begin(), encoded.end(), 0.0f);
    encoded[action.discrete] = 1.0f;
    return;
  }
  for (size_t i = 0; i < low.size(); ++i) {
    const double range = static_cast<double>(high[i]) - low[i];
    const double fraction = (static_cast<double>(action.continuous[i]) - low[i]) / range;
    encoded[i] = static_cast<float>(2.0 * fraction - 1.0);
  }
}

std::vector<float> ActionSpace::FromUnit(absl::Span<const float> unit) const {
  SPIKESERVE_DCHECK(!is_discrete());
  SPIKESERVE_DCHECK_EQ(unit.size(), low.size());
  std::vector<float> values(low.size());
  for (size_t i = 0; i < low.size(); ++i) values[i] = FromUnit(unit[i], i);
  return values;
}

float ActionSpace::FromUnit(float unit, size_t i) const {
  SPIKESERVE_DCHECK_LT(i, low.size());
  const double range = static_cast<double>(high[i]) - low[i];
  const double value = low[i] + 0.5 * (static_cast<double>(unit) + 1.0) * range;
  return static_cast<float>(
      std::clamp(value, static_cast<double>(low[i]), static_cast<double>(high[i])));
}

absl::Status ActionSpace::Contains(const Action& action) const {
  if (is_discrete()) {
    if (action.discrete >= 0 && action.discrete < n) return absl::OkStatus();
    return absl::InvalidArgumentError(absl::StrCat("action: expected an index from 0 to ", n - 1,
                                                   ", received ", action.discrete));
  }
  if (action.continuous.size() != low.size()) {
    return absl::InvalidArgumentError(absl::StrCat("action: expected ", low.size(),
                                                   " values, received ", action.continuous.size()));
  }
  for (size_t i = 0; i < low.size(); ++i) {
    const float value = action.continuous[i];
    if (value >= low[i] && value <= high[i]) continue;  // false for NaN
    return absl::InvalidArgumentError(absl::StrCat("action[", i, "]: expected ", Shortest(low[i]),
                                                   " to ", Shortest(high[i]), ", received ",
                                                   Shortest(value)));
  }
  return absl::OkStatus();
}

absl::Status ActionSpace::Validate() const {
  if (low.empty() && high.empty()) {
    if (n >= 1) return absl::OkStatus();
    return absl::InvalidArgumentError(
        absl::StrCat("action_space.n: expected at least 1, received ", n));
  }
  if (n != 0) {
    return absl::InvalidArgumentError(
        absl::StrCat("action_space: expected n or bounds, received n = ", n, " with bounds"));
  }
  if (low.size() != high.size()) {
    return absl::InvalidArgumentError(
        absl::StrCat("action_space: expected low and high of one length, received ", low.size(),
                     " and ", high.size()));
  }
  for (size_t i = 0; i < low.size(); ++i) {
    if (std::isfinite(low[i]) && std::isfinite(high[i]) && low[i] < high[i]) continue;
    return absl::InvalidArgumentError(absl::StrCat("action_space: expected finite bounds with low[",
                                                   i, "] < high[", i, "], received ", low[i],
                                                   " and ", high[i]));
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
