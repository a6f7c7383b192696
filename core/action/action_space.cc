#include "core/action/action_space.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <string>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
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
    return InvalidArgument("action", absl::StrCat("an index from 0 to ", n - 1), action.discrete);
  }
  if (action.continuous.size() != low.size()) {
    return InvalidArgument("action", absl::StrCat(low.size(), " values"), action.continuous.size());
  }
  for (size_t i = 0; i < low.size(); ++i) {
    const float value = action.continuous[i];
    if (value >= low[i] && value <= high[i]) continue;  // false for NaN
    return InvalidArgument(absl::StrCat("action[", i, "]"),
                           absl::StrCat(Shortest(low[i]), " to ", Shortest(high[i])),
                           Shortest(value));
  }
  return absl::OkStatus();
}

absl::Status ActionSpace::Validate() const {
  if (low.empty() && high.empty()) {
    if (n >= 1) return absl::OkStatus();
    return InvalidArgument("action_space.n", "at least 1", n);
  }
  if (n != 0) {
    return InvalidArgument("action_space", "n or bounds", absl::StrCat("n = ", n, " with bounds"));
  }
  if (low.size() != high.size()) {
    return InvalidArgument("action_space", "low and high of one length",
                           absl::StrCat(low.size(), " and ", high.size()));
  }
  for (size_t i = 0; i < low.size(); ++i) {
    if (std::isfinite(low[i]) && std::isfinite(high[i]) && low[i] < high[i]) continue;
    return InvalidArgument("action_space",
                           absl::StrCat("finite bounds with low[", i, "] < high[", i, "]"),
                           absl::StrCat(low[i], " and ", high[i]));
  }
  return absl::OkStatus();
}

Action NeutralAction(const ActionSpace& space) {
  Action neutral;
  for (size_t i = 0; i < space.low.size(); ++i) {
    const bool admits_zero = space.low[i] <= 0.0f && space.high[i] >= 0.0f;
    neutral.continuous.push_back(admits_zero ? 0.0f : 0.5f * space.low[i] + 0.5f * space.high[i]);
  }
  return neutral;
}

}  // namespace spikeserve
