// A load test: many sessions on one server, in a closed loop or at a fixed rate, for a fixed time.
#pragma once

#include "absl/status/statusor.h"
#include "loadtest/load_options.h"
#include "loadtest/load_report.h"

namespace spikeserve {

// Opens the sessions, runs the callers, and closes the sessions. Returns INVALID_ARGUMENT if
// `options` are invalid, NOT_FOUND for an unknown policy, UNAVAILABLE if the server cannot be
// reached, or the error of opening or closing a session. Failed decisions are not an error; the
// report counts them.
absl::StatusOr<LoadReport> RunLoadTest(const LoadOptions& options);

}  // namespace spikeserve
