#include "server/trace/otlp.h"

#include <unistd.h>

#include <algorithm>
#include <variant>

#include "core/base/version.h"
#include "opentelemetry/proto/collector/trace/v1/trace_service.pb.h"

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

}  // namespace

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

absl::StatusOr<int64_t> ReadRejectedSpans(absl::string_view response) {
  otlp::collector::trace::v1::ExportTraceServiceResponse message;
  if (!message.ParseFromArray(response.data(), static_cast<int>(response.size()))) {
    return absl::InternalError("the collector's answer is no ExportTraceServiceResponse");
  }
  return std::max<int64_t>(0, message.partial_success().rejected_spans());
}

}  // namespace spikeserve
