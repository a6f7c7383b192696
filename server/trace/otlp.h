// The messages of OTLP, the protocol of OpenTelemetry.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <cstdint>
#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/types/span.h"
#include "server/trace/span.h"
#include "server/trace/trace_options.h"

namespace spikeserve {

// Returns an ExportTraceServiceRequest with `spans`.
std::string FormatOtlp(const TraceOptions& options,
                       absl::Span<const std::unique_ptr<SpanRecord>> spans);

// Reads an ExportTraceServiceResponse. Returns how many spans the collector has refused.
absl::StatusOr<int64_t> ReadRejectedSpans(absl::string_view response);

}  // namespace spikeserve
