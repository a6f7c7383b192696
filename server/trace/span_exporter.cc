#include "server/trace/span_exporter.h"

#include <unistd.h>

#include <algorithm>
#include <cstdint>
#include <iterator>
#include <memory>
#include <string>
#include <utility>
#include <variant>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/types/span.h"
#include "core/base/status_macros.h"
#include "core/base/version.h"
#include "opentelemetry/proto/collector/trace/v1/trace_service.pb.h"
#include "server/base/log.h"
#include "server/trace/span.h"
#include "server/trace/trace_options.h"

namespace spikeserve {
namespace {

namespace otlp = opentelemetry::proto;

// The bits of Span.flags.
constexpr uint32_t kSampled = 0x01;
constexpr uint32_t kKnowsParent = 0x100;
constexpr uint32_t kRemoteParent = 0x200;

void AppendBytes(uint64_t id, std::string* bytes) {
  for (int shift = 56; shift >= 0; shift -= 8) {
    bytes->push_back(static_cast<char>(id >> static_cast<unsigned>(shift)));
  }
}

void Add(absl::string_view key, absl::string_view value,
         google::protobuf::RepeatedPtrField<otlp::common::v1::KeyValue>* attributes) {
  auto* attribute = attributes->Add();
  attribute->set_key(std::string(key));
  attribute->mutable_value()->set_string_value(std::string(value));
}

void DescribeProcess(const TraceOptions& options, otlp::resource::v1::Resource* resource) {
  auto* attributes = resource->mutable_attributes();
  Add("service.name", options.service_name, attributes);
  for (const auto& [key, value] : options.resource) Add(key, value, attributes);
  const auto is_given = [&](absl::string_view key) {
    return std::ranges::any_of(options.resource,
                               [&](const auto& pair) { return pair.first == key; });
  };
  if (!is_given("service.version")) Add("service.version", Version(), attributes);
  if (!is_given("process.pid")) {
    auto* pid = attributes->Add();
    pid->set_key("process.pid");
    pid->mutable_value()->set_int_value(getpid());
  }
}

otlp::trace::v1::Span::SpanKind KindOf(SpanKind kind) {
  switch (kind) {
    case SpanKind::kServer:
      return otlp::trace::v1::Span::SPAN_KIND_SERVER;
    case SpanKind::kClient:
      return otlp::trace::v1::Span::SPAN_KIND_CLIENT;
    case SpanKind::kInternal:
      break;
  }
  return otlp::trace::v1::Span::SPAN_KIND_INTERNAL;
}

void ToProto(const SpanRecord::Attribute& attribute, otlp::common::v1::KeyValue* proto) {
  proto->set_key(attribute.key);
  auto* value = proto->mutable_value();
  if (const auto* number = std::get_if<int64_t>(&attribute.value)) {
    value->set_int_value(*number);
  } else if (const auto* real = std::get_if<double>(&attribute.value)) {
    value->set_double_value(*real);
  } else {
    value->set_string_value(std::get<std::string>(attribute.value));
  }
}

void ToProto(const SpanRecord& span, const TraceOptions& options, otlp::trace::v1::Span* proto) {
  AppendBytes(span.trace_high, proto->mutable_trace_id());
  AppendBytes(span.trace_low, proto->mutable_trace_id());
  AppendBytes(span.id, proto->mutable_span_id());
  if (span.parent != 0) AppendBytes(span.parent, proto->mutable_parent_span_id());
  proto->set_flags(kSampled | kKnowsParent | (span.has_remote_parent ? kRemoteParent : 0));
  proto->set_name(span.name);
  proto->set_kind(KindOf(span.kind));
  proto->set_start_time_unix_nano(static_cast<uint64_t>(span.begin_nanos));
  // The time of day may have been set back meanwhile.
  proto->set_end_time_unix_nano(static_cast<uint64_t>(std::max(span.begin_nanos, span.end_nanos)));
  for (const auto& attribute : span.attributes) ToProto(attribute, proto->add_attributes());
  if (span.is_of_store && !options.store_system.empty()) {
    Add("db.system.name", options.store_system, proto->mutable_attributes());
  }
  if (!span.failed) return;
  proto->mutable_status()->set_code(otlp::trace::v1::Status::STATUS_CODE_ERROR);
  proto->mutable_status()->set_message(span.error);
}

// Returns an ExportTraceServiceRequest with `spans`.
std::string FormatOtlp(const TraceOptions& options,
                       absl::Span<const std::unique_ptr<SpanRecord>> spans) {
  otlp::collector::trace::v1::ExportTraceServiceRequest request;
  auto* of_process = request.add_resource_spans();
  DescribeProcess(options, of_process->mutable_resource());
  auto* of_scope = of_process->add_scope_spans();
  of_scope->mutable_scope()->set_name("spikeserve");
  of_scope->mutable_scope()->set_version(std::string(Version()));
  for (const auto& span : spans) ToProto(*span, options, of_scope->add_spans());
  return request.SerializeAsString();
}

// Reads an ExportTraceServiceResponse. Returns how many spans the collector has refused.
absl::StatusOr<int64_t> ReadRejectedSpans(absl::string_view response) {
  otlp::collector::trace::v1::ExportTraceServiceResponse message;
  if (!message.ParseFromArray(response.data(), static_cast<int>(response.size()))) {
    return absl::InternalError("the collector's answer is no ExportTraceServiceResponse");
  }
  return std::max<int64_t>(0, message.partial_success().rejected_spans());
}

constexpr char kPath[] = "/opentelemetry.proto.collector.trace.v1.TraceService/Export";
constexpr absl::Duration kStopTime = absl::Seconds(2);
constexpr absl::Duration kFirstResend = absl::Seconds(1);
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
  absl::Duration delay = kFirstResend;
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
