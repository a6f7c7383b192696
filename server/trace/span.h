// A span: what one piece of work was, when it began and ended, and what it belongs to.
//
//   Span call = tracer->Start("spikeserve.v1.PolicyService/Act", parent);
//   {
//     Span decision = call.Child("decide");
//     decision.Set("spikeserve.spikes", spikes);
//   }                                // ends here
//   call.Fail(absl::InternalError("..."));
//   call.End();
//
// Of requests that are not sampled there are empty spans, which cost a null pointer: no method of
// an empty span does anything, and its children are empty. So callers need not ask; where the value
// of an attribute costs something, they ask `if (span)`.
//
// Not thread-safe, except that Child() and Store() may be called by several threads at a time while
// the span is neither ended nor moved.
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <utility>
#include <variant>

#include "absl/container/inlined_vector.h"
#include "absl/status/status.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

enum class SpanKind {
  kInternal,
  kServer,  // the answer to a request
  kClient,  // a question to another program
};

class SpanSink;

// What a span tells when it has ended.
struct SpanRecord {
  struct Attribute {
    const char* key;  // a constant of the program
    std::variant<int64_t, double, std::string> value;
  };

  SpanSink* sink = nullptr;
  uint64_t trace_high = 0, trace_low = 0;  // see TraceParent
  uint64_t id = 0;
  uint64_t parent = 0;             // 0: the first span of its trace
  bool has_remote_parent = false;  // the parent belongs to another program
  bool is_of_store = false;        // a question to the session store
  std::string name;
  SpanKind kind = SpanKind::kInternal;
  int64_t begin_nanos = 0, end_nanos = 0;  // since 1970
  bool failed = false;
  std::string error = "";  // why
  absl::InlinedVector<Attribute, 8> attributes = {};
};

// Takes the spans that have ended. Thread-safe.
class SpanSink {
 public:
  virtual ~SpanSink() = default;
  virtual void Take(std::unique_ptr<SpanRecord> record) = 0;
};

class Span {
 public:
  Span() = default;
  // Begins now. `record` has its sink, which must outlive the span.
  explicit Span(std::unique_ptr<SpanRecord> record);
  Span(Span&& other) noexcept = default;
  Span& operator=(Span&& other) noexcept {
    End();
    record_ = std::move(other.record_);
    return *this;
  }
  ~Span() { End(); }

  // Returns true unless the span is empty.
  explicit operator bool() const { return record_ != nullptr; }

  // Begins a span that belongs to this one.
  Span Child(absl::string_view name, SpanKind kind = SpanKind::kInternal) const {
    return record_ == nullptr ? Span() : NewChild(name, kind);
  }
  // As Child(), for a question to the session store.
  Span Store(absl::string_view name) const;

  // Lets the span begin now, for one that was made earlier than its work began.
  void Restart();

  // Adds an attribute. `key` is a constant of the program.
  void Set(const char* key, int64_t value);
  void Set(const char* key, double value);
  void Set(const char* key, absl::string_view value);
  // Says that the work has failed, unless `status` is OK.
  void Fail(const absl::Status& status);

  // Forgets the work, which was not done after all.
  void Cancel() { record_ = nullptr; }
  // Ends the span, which is empty then.
  void End() {
    if (record_ != nullptr) Finish();
  }

 private:
  Span NewChild(absl::string_view name, SpanKind kind) const;
  void Finish();

  std::unique_ptr<SpanRecord> record_;
};

// Returns a number other than 0 for the id of a span, or for a half of that of a trace.
uint64_t NewSpanId();

}  // namespace spikeserve
