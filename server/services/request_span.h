// The span of one request that a server answers (OpenTelemetry's conventions for RPC).
//
// Free functions, safe to call from many threads.
#pragma once

#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "server/access/authenticator.h"
#include "server/base/trace_parent.h"
#include "server/trace/span.h"
#include "server/trace/tracer.h"

namespace spikeserve {

// Begins the span of a request for the method at `path`, "/package.Service/Method". Empty if it is
// not sampled.
Span StartRequestSpan(Tracer& tracer, absl::string_view path, const TraceParent& parent);

// Ends the span of a request of `caller` that is answered with `status`.
void FinishRequestSpan(const Credential& caller, const absl::Status& status, Span* span);

}  // namespace spikeserve
