// Attaches to an error the time after which the caller may retry, as google.rpc.RetryInfo.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/time/time.h"

namespace spikeserve {

// Returns `status` with `delay` attached. REQUIRES: `status` is not OK.
absl::Status WithRetryDelay(absl::Status status, absl::Duration delay);

// Returns the delay that WithRetryDelay attached to `status`, if any.
std::optional<absl::Duration> RetryDelay(const absl::Status& status);

// Returns the serialized google.rpc.Status of a status with payloads, such as a retry delay, which
// gRPC sends as `grpc-status-details-bin`; empty if `status` has none.
std::string SerializedDetails(const absl::Status& status);

}  // namespace spikeserve
