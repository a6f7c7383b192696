// A load test: many sessions against one server, in closed loop or at a rate, for a bounded time.
#ifndef LOADTEST_LOAD_TEST_H_
#define LOADTEST_LOAD_TEST_H_

#include "absl/status/statusor.h"
#include "loadtest/load_options.h"
#include "loadtest/load_report.h"

namespace spikeserve {

// Opens the sessions, runs the callers, and closes the sessions again. INVALID_ARGUMENT if
// `options` are not valid, NOT_FOUND if there is no such policy, UNAVAILABLE if the server cannot
// be reached, or why the sessions could not be opened or closed. Failed decisions are counted in
// the report.
absl::StatusOr<LoadReport> RunLoadTest(const LoadOptions& options);

}  // namespace spikeserve

#endif  // LOADTEST_LOAD_TEST_H_
