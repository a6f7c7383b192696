// Sends spans to a collector, on a thread of its own, in batches. Nothing else waits for it: spans
// that find the buffer full are dropped and counted.
//
// Thread-safe, except Stop().
#pragma once

#include <memory>
#include <thread>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "core/base/steady_wait.h"
#include "prometheus/counter.h"
#include "prometheus/registry.h"
#include "server/trace/otlp_client.h"
#include "server/trace/span.h"
#include "server/trace/trace_options.h"

namespace spikeserve {

class SpanExporter final : public SpanSink {
 public:
  // Registers spikeserve_trace_spans_total{outcome} in `registry`, which must outlive the exporter:
  // exported; dropped, because the buffer was full; or failed, because the collector has not taken
  // them.
  static absl::StatusOr<std::unique_ptr<SpanExporter>> Create(const TraceOptions& options,
                                                              prometheus::Registry* registry);
  ~SpanExporter() override { Stop(); }

  void Take(std::unique_ptr<SpanRecord> record) override;

  // Sends what is in the buffer, for at most two seconds, and ends the thread. Later spans are
  // dropped.
  void Stop();

 private:
  using Batch = std::vector<std::unique_ptr<SpanRecord>>;

  SpanExporter(const TraceOptions& options, std::unique_ptr<OtlpClient> client,
               prometheus::Registry* registry);
  void Run();
  // Waits for a batch, or for `delay` for a smaller one. Empty: none came, or the exporter stops.
  Batch Next() ABSL_LOCKS_EXCLUDED(mutex_);
  void Send(const Batch& batch);
  // Returns the time that a call may take, 0 if the exporter has stopped.
  absl::Duration TimeLeft() const ABSL_LOCKS_EXCLUDED(mutex_);
  // Returns false if the exporter stops meanwhile.
  bool WaitToRetry(absl::Duration delay) ABSL_LOCKS_EXCLUDED(mutex_);
  bool is_stopping() const ABSL_LOCKS_EXCLUDED(mutex_) {
    absl::MutexLock lock(&mutex_);
    return stopping_;
  }

  const TraceOptions options_;
  const SteadyClock clock_;
  const std::unique_ptr<OtlpClient> client_;  // of the thread
  prometheus::Counter& exported_;
  prometheus::Counter& dropped_;
  prometheus::Counter& failed_;

  mutable absl::Mutex mutex_;
  SteadyCondition changed_;  // a batch is full, or `stopping_`
  Batch queue_ ABSL_GUARDED_BY(mutex_);
  bool stopping_ ABSL_GUARDED_BY(mutex_) = false;
  absl::Duration stop_by_ ABSL_GUARDED_BY(mutex_);  // of the clock
  std::thread thread_;  // declared last, because it uses the members above
};

}  // namespace spikeserve
