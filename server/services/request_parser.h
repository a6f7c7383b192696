// Parses requests, with a bound on the memory that the bytes of a request can occupy.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <google/protobuf/message.h>

#include <cstdint>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

// The largest number of elements in one request: messages, strings and unknown fields, at every
// level. Two bytes are enough for an element, which occupies about a hundred bytes of memory when
// it is parsed. Packed arrays of numbers count as one element.
inline constexpr int64_t kMaxElements = 16'384;

// Parses `bytes` into `request`. Returns INTERNAL, as gRPC's own servers answer, if they are no
// message of its type, and INVALID_ARGUMENT if they have more than kMaxElements elements, or if an
// item of a list of messages is empty: it costs two bytes here and a hundred times as much when it
// is parsed and answered. Both are checked before anything is stored.
absl::Status ParseRequest(absl::string_view bytes, google::protobuf::Message* request);

}  // namespace spikeserve
