#include "server/agent/feature_names.h"

#include <cmath>

#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

absl::Status CheckRate(double rate_hz, const Features& features) {
  if (!features.rate_hz.has_value()) {
    return absl::InvalidArgumentError(absl::StrCat(
        "rate_hz: expected none, because the policy file has no rate, received ", rate_hz));
  }
  const double expected = *features.rate_hz;
  if (std::abs(rate_hz - expected) <= features.rate_tolerance * expected) return absl::OkStatus();
  return absl::InvalidArgumentError(absl::StrCat("rate_hz: expected ", expected, " within ",
                                                 100.0 * features.rate_tolerance, " %, received ",
                                                 rate_hz));
}

}  // namespace

absl::Status CheckFeatures(const v1::OpenSessionRequest& request, const Features& features) {
  const ReceivedNames observation = {
      .field = "observation",
      .names = {request.observation_names().begin(), request.observation_names().end()},
      .units = {request.observation_units().begin(), request.observation_units().end()}};
  RETURN_IF_ERROR(CheckNames(features.observation, observation, request.names_in_any_order()));
  const ReceivedNames action = {
      .field = "action",
      .names = {request.action_names().begin(), request.action_names().end()},
      .units = {request.action_units().begin(), request.action_units().end()}};
  RETURN_IF_ERROR(CheckNames(features.action, action, request.names_in_any_order()));
  return request.has_rate_hz() ? CheckRate(request.rate_hz(), features) : absl::OkStatus();
}

}  // namespace spikeserve
