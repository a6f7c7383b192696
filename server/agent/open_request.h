// What an OpenSession asks for: the settings of the session, and the version that it plays.
//
// Pure functions; thread-safe.
#pragma once

#include <cstddef>
#include <string>

#include "absl/status/statusor.h"
#include "core/agent/served_policy.h"
#include "core/session/session.h"
#include "server/policies/policy_catalog.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// Limits on the labels and the routing key of one OpenSession, which the server stores or hashes.
struct LabelLimits {
  static constexpr int kLabels = 32;
  static constexpr size_t kBytes = 256;  // of a key, a value or a routing key
};

// Returns the settings of a session of `served`. INVALID_ARGUMENT names the first field that is not
// valid: names and units of elements, settings, labels, wiring, period_seconds.
absl::StatusOr<SessionOptions> OptionsFromProto(const v1::OpenSessionRequest& request,
                                                const ServedPolicy& served);

// Returns the version that a new session is opened on. Without a routing key, the session's id
// decides its share of the traffic. INVALID_ARGUMENT for a routing key that is too long; otherwise
// the errors of PolicyCatalog::Choose.
absl::StatusOr<ChosenVersions> ChooseRoute(const v1::OpenSessionRequest& request,
                                           const std::string& id, const PolicyCatalog& catalog);

}  // namespace spikeserve
