// The header `traceparent` of W3C Trace Context: the span of the caller that a request belongs to.
//
//   const TraceParent parent = ParseTraceParent(value);
//   if (parent.is_valid() && parent.sampled) ...
//
// Plain data and a free function; safe to use from many threads.
#pragma once

#include <cstdint>

#include "absl/strings/string_view.h"

namespace spikeserve {

struct TraceParent {
  // The bytes of the ids as they are written, the most significant first. All 0: none.
  uint64_t trace_high = 0;
  uint64_t trace_low = 0;
  uint64_t span = 0;
  bool sampled = false;

  bool is_valid() const { return span != 0; }
};

// Returns the span that `value` names, and an invalid one if the standard calls the value invalid.
// Later versions of the format are read as far as this one knows them.
TraceParent ParseTraceParent(absl::string_view value);

}  // namespace spikeserve
