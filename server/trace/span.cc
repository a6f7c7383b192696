#include "server/trace/span.h"

#include "absl/random/random.h"
#include "absl/time/clock.h"

namespace spikeserve {
namespace {

// Adds an attribute and returns its value, which is still to be set.
auto& Add(const char* key, decltype(SpanRecord::attributes)* attributes) {
  attributes->resize(attributes->size() + 1);
  attributes->back().key = key;
  return attributes->back().value;
}

}  // namespace

uint64_t NewSpanId() {
  thread_local absl::InsecureBitGen generator;
  while (true) {
    if (const uint64_t id = absl::Uniform<uint64_t>(generator); id != 0) return id;
  }
}

Span::Span(std::unique_ptr<SpanRecord> record) : record_(std::move(record)) { Restart(); }

Span Span::NewChild(absl::string_view name, SpanKind kind) const {
  auto child = std::make_unique<SpanRecord>();
  child->sink = record_->sink;
  child->trace_high = record_->trace_high;
  child->trace_low = record_->trace_low;
  child->id = NewSpanId();
  child->parent = record_->id;
  child->name.assign(name.data(), name.size());
  child->kind = kind;
  return Span(std::move(child));
}

Span Span::Store(absl::string_view name) const {
  Span span = Child(name, SpanKind::kClient);
  if (span) span.record_->is_of_store = true;
  return span;
}

void Span::Restart() {
  if (record_ != nullptr) record_->begin_nanos = absl::GetCurrentTimeNanos();
}

void Span::Set(const char* key, int64_t value) {
  if (record_ != nullptr) Add(key, &record_->attributes).emplace<int64_t>(value);
}

void Span::Set(const char* key, double value) {
  if (record_ != nullptr) Add(key, &record_->attributes).emplace<double>(value);
}

void Span::Set(const char* key, absl::string_view value) {
  if (record_ != nullptr) Add(key, &record_->attributes).emplace<std::string>(value);
}

void Span::Fail(const absl::Status& status) {
  if (record_ == nullptr || status.ok()) return;
  record_->failed = true;
  record_->error.assign(status.message().data(), status.message().size());
}

void Span::Finish() {
  record_->end_nanos = absl::GetCurrentTimeNanos();
  SpanSink* const sink = record_->sink;
  sink->Take(std::move(record_));
}

}  // namespace spikeserve
