#include "server/agent/open_request.h"

#include <algorithm>
#include <cmath>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "core/agent/wiring_check.h"
#include "core/base/printable.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/model/features.h"
#include "core/open_sessions/session_store.h"
#include "server/messages/convert.h"

namespace spikeserve {
namespace {

absl::Status CheckRate(double rate_hz, const Features& features) {
  if (!features.rate_hz.has_value()) {
    return InvalidArgument("rate_hz", "none, because the policy file has no rate", rate_hz);
  }
  const double expected = *features.rate_hz;
  if (std::abs(rate_hz - expected) <= features.rate_tolerance * expected) return absl::OkStatus();
  return InvalidArgument("rate_hz",
                         absl::StrCat(expected, " within ", 100.0 * features.rate_tolerance, " %"),
                         rate_hz);
}

// Returns INVALID_ARGUMENT, which names the field, if a name, a unit or the rate of `request`
// differs from `features`, or if they have none to compare it with.
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

absl::Status CheckLabels(const google::protobuf::Map<std::string, std::string>& labels) {
  if (labels.size() > LabelLimits::kLabels) {
    return InvalidArgument("labels", absl::StrCat("at most ", LabelLimits::kLabels), labels.size());
  }
  for (const auto& [key, value] : labels) {
    const size_t longest = std::max(key.size(), value.size());
    if (longest > LabelLimits::kBytes) {
      return InvalidArgument(
          "labels", absl::StrCat("keys and values of at most ", LabelLimits::kBytes, " bytes"),
          absl::StrCat("one of ", longest));
    }
    if (!IsPrintable(key) || !IsPrintable(value)) {
      return InvalidArgument("labels", "printable characters in UTF-8",
                             absl::StrCat(Quoted(key), ": ", Quoted(value)));
    }
  }
  return absl::OkStatus();
}

absl::Status CheckPeriod(const std::string& text) {
  double seconds = 0.0;
  const bool is_number = absl::SimpleAtod(text, &seconds);
  if (is_number && seconds >= 0.001 && seconds <= 3600.0) return absl::OkStatus();  // false for NaN
  return InvalidArgument("period_seconds", "0.001 to 3600", Quoted(text));
}

}  // namespace

absl::StatusOr<SessionOptions> OptionsFromProto(const v1::OpenSessionRequest& request,
                                                const ServedPolicy& served) {
  RETURN_IF_ERROR(CheckFeatures(request, served.policy().features));
  ASSIGN_OR_RETURN(auto settings, RequestFromProto(request));
  ASSIGN_OR_RETURN(auto options, ResolveSession(std::move(settings), served));
  options.policy_sha256 = served.sha256;
  RETURN_IF_ERROR(CheckLabels(request.labels()));
  options.labels.insert(request.labels().begin(), request.labels().end());
  if (!v1::WiringResponse_IsValid(request.wiring())) {
    return InvalidArgument("wiring", "WIRING_DEFAULT, WIRING_COUNT, WIRING_WARN or WIRING_SAFE",
                           static_cast<int>(request.wiring()));
  }
  if (request.wiring() != v1::WIRING_DEFAULT) {
    const auto wiring = static_cast<WiringResponse>(request.wiring() - v1::WIRING_COUNT);
    options.labels[kWiringLabel] = std::string(ToString(wiring));
  }
  if (request.has_period_seconds()) {
    options.labels[kPeriodLabel] = absl::StrCat(request.period_seconds());
  }
  const auto period = options.labels.find(kPeriodLabel);  // which a client may also have set itself
  if (period != options.labels.end()) RETURN_IF_ERROR(CheckPeriod(period->second));
  return options;
}

absl::StatusOr<ChosenVersions> ChooseRoute(const v1::OpenSessionRequest& request,
                                           const std::string& id, const PolicyCatalog& catalog) {
  const std::string& key = request.routing_key();
  if (key.size() > LabelLimits::kBytes) {
    return InvalidArgument("routing_key", absl::StrCat("at most ", LabelLimits::kBytes, " bytes"),
                           key.size());
  }
  return catalog.Choose({.policy = request.policy(),
                         .version = request.version(),
                         .label = request.version_label(),
                         .routing_key = key.empty() ? id : key});
}

}  // namespace spikeserve
