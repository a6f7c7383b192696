#include "server/agent/open_request.h"

#include <algorithm>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "core/agent/wiring_check.h"
#include "core/base/printable.h"
#include "core/base/status_macros.h"
#include "core/open_sessions/session_store.h"
#include "server/agent/feature_names.h"
#include "server/messages/convert.h"

namespace spikeserve {
namespace {

absl::Status CheckLabels(const google::protobuf::Map<std::string, std::string>& labels) {
  if (labels.size() > LabelLimits::kLabels) {
    return absl::InvalidArgumentError(absl::StrCat(
        "labels: expected at most ", LabelLimits::kLabels, ", received ", labels.size()));
  }
  for (const auto& [key, value] : labels) {
    const size_t longest = std::max(key.size(), value.size());
    if (longest > LabelLimits::kBytes) {
      return absl::InvalidArgumentError(absl::StrCat("labels: expected keys and values of at most ",
                                                     LabelLimits::kBytes,
                                                     " bytes, received one of ", longest));
    }
    if (!IsPrintable(key) || !IsPrintable(value)) {
      return absl::InvalidArgumentError(
          absl::StrCat("labels: expected printable characters in UTF-8, received ", Quoted(key),
                       ": ", Quoted(value)));
    }
  }
  return absl::OkStatus();
}

absl::Status CheckPeriod(const std::string& text) {
  double seconds = 0.0;
  const bool is_number = absl::SimpleAtod(text, &seconds);
  if (is_number && seconds >= 0.001 && seconds <= 3600.0) return absl::OkStatus();  // false for NaN
  return absl::InvalidArgumentError(
      absl::StrCat("period_seconds: expected 0.001 to 3600, received ", Quoted(text)));
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
    return absl::InvalidArgumentError(absl::StrCat(
        "wiring: expected WIRING_DEFAULT, WIRING_COUNT, WIRING_WARN or WIRING_SAFE, received ",
        static_cast<int>(request.wiring())));
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

absl::StatusOr<Route> ChooseRoute(const v1::OpenSessionRequest& request, const std::string& id,
                                  const PolicyCatalog& catalog) {
  const std::string& key = request.routing_key();
  if (key.size() > LabelLimits::kBytes) {
    return absl::InvalidArgumentError(absl::StrCat(
        "routing_key: expected at most ", LabelLimits::kBytes, " bytes, received ", key.size()));
  }
  return catalog.Choose({.policy = request.policy(),
                         .version = request.version(),
                         .label = request.version_label(),
                         .routing_key = key.empty() ? id : key});
}

}  // namespace spikeserve
