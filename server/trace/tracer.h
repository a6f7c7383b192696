// Decides which requests are traced, and begins their spans.
//
//   auto tracer = Tracer::Create(options, &registry);
//   Span span = (*tracer)->Start(path, parent);  // empty if the request is not sampled
//
// Thread-safe, except Stop().
#pragma once

#include <memory>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
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
                                                        prometheus::Registry* registry);

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
  bool IsChosen(const TraceParent& parent) const;
  Span Begin(absl::string_view name, const TraceParent& parent, SpanKind kind);

  const double ratio_;
  const bool follows_parent_;
  const bool reads_parent_;
  const std::unique_ptr<SpanExporter> exporter_;
};

}  // namespace spikeserve
