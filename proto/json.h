// Converts protobuf messages to JSON.
#ifndef PROTO_JSON_H_
#define PROTO_JSON_H_

#include <google/protobuf/message.h>

#include <string>

#include "absl/status/statusor.h"

namespace spikeserve {

// Returns `message` in the proto3 JSON mapping, with the field names of the .proto file, with
// fields that are 0 or empty, and with 64-bit integers as strings. Returns INTERNAL if protobuf
// cannot convert the message, for example because a string is not UTF-8. Thread-safe.
absl::StatusOr<std::string> MessageToJson(const google::protobuf::Message& message);

}  // namespace spikeserve

#endif  // PROTO_JSON_H_
