#include "server/base/trace_parent.h"

#include <cstddef>

namespace spikeserve {
namespace {

// 00-<32 digits>-<16 digits>-<2 digits>
constexpr size_t kLength = 55;
constexpr size_t kTraceAt = 3, kSpanAt = 36, kFlagsAt = 53;

// Reads hexadecimal digits in lower case. Returns false if there are others.
bool ReadHex(absl::string_view digits, uint64_t* value) {
  *value = 0;
  for (const char digit : digits) {
    uint64_t nibble = 0;
    if (digit >= '0' && digit <= '9') {
      nibble = static_cast<uint64_t>(digit - '0');
    } else if (digit >= 'a' && digit <= 'f') {
      nibble = static_cast<uint64_t>(digit - 'a') + 10;
    } else {
      return false;
    }
    *value = *value << 4U | nibble;
  }
  return true;
}

}  // namespace

TraceParent ParseTraceParent(absl::string_view value) {
  if (value.size() < kLength || value[2] != '-' || value[kSpanAt - 1] != '-' ||
      value[kFlagsAt - 1] != '-') {
    return {};
  }
  constexpr uint64_t kNoVersion = 0xff;
  uint64_t version = 0, flags = 0;
  TraceParent parent;
  if (!ReadHex(value.substr(0, 2), &version) || version == kNoVersion ||
      !ReadHex(value.substr(kTraceAt, 16), &parent.trace_high) ||
      !ReadHex(value.substr(kTraceAt + 16, 16), &parent.trace_low) ||
      !ReadHex(value.substr(kSpanAt, 16), &parent.span) ||
      !ReadHex(value.substr(kFlagsAt, 2), &flags)) {
    return {};
  }
  if (value.size() > kLength && (version == 0 || value[kLength] != '-')) return {};
  if (parent.span == 0 || (parent.trace_high | parent.trace_low) == 0) return {};
  parent.sampled = (flags & 1U) != 0;
  return parent;
}

}  // namespace spikeserve
