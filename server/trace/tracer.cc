#include "server/trace/tracer.h"

#include <cmath>
#include <cstdint>
#include <utility>

#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"

namespace spikeserve {

absl::StatusOr<std::unique_ptr<Tracer>> Tracer::Create(const TraceOptions& options,
                                                       prometheus::Registry* registry) {
  SPIKESERVE_DCHECK(options.enabled());
  ASSIGN_OR_RETURN(auto exporter, SpanExporter::Create(options, registry));
  return std::unique_ptr<Tracer>(new Tracer(options, std::move(exporter)));
}

bool Tracer::IsChosen(const TraceParent& parent) const {
  // The low 56 bits of a trace's id are random.
  constexpr int kBits = 56;
  const bool known = reads_parent_ && parent.is_valid();
  const uint64_t drawn = (known ? parent.trace_low : NewSpanId()) & ((uint64_t{1} << kBits) - 1);
  return std::ldexp(static_cast<double>(drawn), -kBits) < ratio_;
}

Span Tracer::Begin(absl::string_view name, const TraceParent& parent, SpanKind kind) {
  auto record = std::make_unique<SpanRecord>();
  record->sink = exporter_.get();
  record->id = NewSpanId();
  record->name.assign(name.data(), name.size());
  record->kind = kind;
  if (reads_parent_ && parent.is_valid()) {
    record->trace_high = parent.trace_high;
    record->trace_low = parent.trace_low;
    record->parent = parent.span;
    record->has_remote_parent = true;
  } else {
    record->trace_high = NewSpanId();
    record->trace_low = NewSpanId();
  }
  return Span(std::move(record));
}

}  // namespace spikeserve
