#include "server/trace/span_exporter.h"

#include <algorithm>
#include <iterator>
#include <utility>

#include "core/base/status_macros.h"
#include "server/base/log.h"
#include "server/trace/otlp.h"

namespace spikeserve {
namespace {

constexpr char kPath[] = "/opentelemetry.proto.collector.trace.v1.TraceService/Export";
constexpr absl::Duration kStopTime = absl::Seconds(2);
constexpr absl::Duration kFirstRetry = absl::Seconds(1);
// A collector that is restarted is back within the time of these tries: 15 seconds.
constexpr int kTries = 5;

// As the specification of OTLP lists them.
bool MayRetry(const absl::Status& status) {
  switch (status.code()) {
    case absl::StatusCode::kCancelled:
    case absl::StatusCode::kDeadlineExceeded:
    case absl::StatusCode::kAborted:
    case absl::StatusCode::kOutOfRange:
    case absl::StatusCode::kUnavailable:
    case absl::StatusCode::kDataLoss:
      return true;
    default:
      return false;
  }
}

prometheus::Counter& AddCounter(prometheus::Registry* registry, const char* outcome) {
  return prometheus::BuildCounter()
      .Name("spikeserve_trace_spans_total")
      .Help(
          "Spans that the collector has taken, or that were dropped because the buffer was full, "
          "or that could not be sent.")
      .Register(*registry)
      .Add({{"outcome", outcome}});
}

}  // namespace

absl::StatusOr<std::unique_ptr<SpanExporter>> SpanExporter::Create(const TraceOptions& options,
                                                                   prometheus::Registry* registry) {
  ASSIGN_OR_RETURN(auto client, OtlpClient::Create(options));
  return std::unique_ptr<SpanExporter>(new SpanExporter(options, std::move(client), registry));
}

SpanExporter::SpanExporter(const TraceOptions& options, std::unique_ptr<OtlpClient> client,
                           prometheus::Registry* registry)
    : options_(options),
      client_(std::move(client)),
      exported_(AddCounter(registry, "exported")),
      dropped_(AddCounter(registry, "dropped")),
      failed_(AddCounter(registry, "failed")),
      thread_([this] { Run(); }) {}

void SpanExporter::Take(std::unique_ptr<SpanRecord> record) {
  absl::MutexLock lock(&mutex_);
  if (stopping_ || queue_.size() >= options_.queue) return dropped_.Increment();
  queue_.push_back(std::move(record));
  if (queue_.size() == options_.batch) changed_.NotifyAll();
}

void SpanExporter::Stop() {
  if (!thread_.joinable()) return;
  {
    absl::MutexLock lock(&mutex_);
    stopping_ = true;
    stop_by_ = clock_.Now() + kStopTime;
    changed_.NotifyAll();
  }
  thread_.join();
}

void SpanExporter::Run() {
  while (true) {
    const bool stopping = is_stopping();
    const Batch batch = Next();
    if (!batch.empty()) {
      Send(batch);
    } else if (stopping) {
      return;
    }
  }
}

SpanExporter::Batch SpanExporter::Next() {
  absl::MutexLock lock(&mutex_);
  changed_.Wait(&mutex_, options_.delay, [this]() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    return stopping_ || queue_.size() >= options_.batch;
  });
  const auto end =
      queue_.begin() + static_cast<std::ptrdiff_t>(std::min(queue_.size(), options_.batch));
  Batch batch(std::make_move_iterator(queue_.begin()), std::make_move_iterator(end));
  queue_.erase(queue_.begin(), end);
  return batch;
}

absl::Duration SpanExporter::TimeLeft() const {
  absl::MutexLock lock(&mutex_);
  if (!stopping_) return options_.timeout;
  return std::clamp(stop_by_ - clock_.Now(), absl::ZeroDuration(), options_.timeout);
}

bool SpanExporter::WaitToRetry(absl::Duration delay) {
  absl::MutexLock lock(&mutex_);
  return !changed_.Wait(&mutex_, delay,
                        [this]() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) { return stopping_; });
}

void SpanExporter::Send(const Batch& batch) {
  const auto spans = static_cast<double>(batch.size());
  const std::string request = FormatOtlp(options_, batch);
  absl::StatusOr<int64_t> rejected;
  absl::Duration delay = kFirstRetry;
  for (int tries = 1;; ++tries) {
    const auto response = client_->Call(kPath, request, TimeLeft());
    rejected = response.ok() ? ReadRejectedSpans(*response) : response.status();
    if (rejected.ok() || !MayRetry(rejected.status()) || tries == kTries) break;
    if (!WaitToRetry(delay)) break;
    delay *= 2;
  }
  if (!rejected.ok()) {
    failed_.Increment(spans);
    return LogWarning("spans not sent", {{"error", rejected.status().message()}});
  }
  failed_.Increment(static_cast<double>(*rejected));
  exported_.Increment(std::max(0.0, spans - static_cast<double>(*rejected)));
}

}  // namespace spikeserve
