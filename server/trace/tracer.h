// Decides which requests are traced, and begins their spans.
//
//   auto tracer = Tracer::Create(options, &registry);
//   Span span = (*tracer)->Start(path, parent);  // empty if the request is not sampled
//
// Thread-safe, except Stop().
#pragma once

#include <cmath>
#include <cstdint>
#include <memory>
#include <utility>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "prometheus/registry.h"
#include "server/base/trace_parent.h"
#include "server/trace/span.h"
#include "server/trace/span_exporter.h"
#include "server/trace/trace_options.h"

namespace spikeserve {

class Tracer {
 public:
  // Registers the metrics of SpanExporter in `registry`, which must outlive the tracer, as must all
  // spans. Returns an error that names the variable if a file of certificates cannot be used.
  // REQUIRES: options.enabled().
  static absl::StatusOr<std::unique_ptr<Tracer>> Create(const TraceOptions& options,
                                                        prometheus::Registry* registry) {
    SPIKESERVE_DCHECK(options.enabled());
    ASSIGN_OR_RETURN(auto exporter, SpanExporter::Create(options, registry));
    return std::unique_ptr<Tracer>(new Tracer(options, std::move(exporter)));
  }

  // Begins the span of a request, whose caller may have sent `parent`.
  Span Start(absl::string_view name, const TraceParent& parent) {
    return IsSampled(parent) ? Begin(name, parent, SpanKind::kServer) : Span();
  }
  // Begins a trace of work that no request asked for.
  Span Start(absl::string_view name) {
    return IsSampled({}) ? Begin(name, {}, SpanKind::kInternal) : Span();
  }

  // Sends the spans that have ended, for at most two seconds. Later ones are dropped.
  void Stop() { exporter_->Stop(); }

 private:
  Tracer(const TraceOptions& options, std::unique_ptr<SpanExporter> exporter)
      : ratio_(options.ratio),
        follows_parent_(options.follows_parent),
        reads_parent_(options.reads_parent),
        exporter_(std::move(exporter)) {}

  bool IsSampled(const TraceParent& parent) const {
    if (follows_parent_ && reads_parent_ && parent.is_valid()) return parent.sampled;
    return ratio_ >= 1.0 || (ratio_ > 0.0 && IsChosen(parent));
  }
  // Chooses `ratio_` of the traces, the same ones on each server.
  bool IsChosen(const TraceParent& parent) const {
    // The low 56 bits of a trace's id are random.
    constexpr int kBits = 56;
    const bool known = reads_parent_ && parent.is_valid();
    const uint64_t drawn = (known ? parent.trace_low : NewSpanId()) & ((uint64_t{1} << kBits) - 1);
    return std::ldexp(static_cast<double>(drawn), -kBits) < ratio_;
  }

  Span Begin(absl::string_view name, const TraceParent& parent, SpanKind kind) {
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

  const double ratio_;
  const bool follows_parent_;
  const bool reads_parent_;
  const std::unique_ptr<SpanExporter> exporter_;
};

}  // namespace spikeserve
