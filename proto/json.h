// Converts protobuf messages to JSON and back.
#pragma once

#include <google/protobuf/message.h>

#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

// Returns `message` in the proto3 JSON mapping, with the field names of the .proto file, with
// fields that are 0 or empty, and with 64-bit integers as strings. Returns INTERNAL if protobuf
// cannot convert the message, for example because a string is not UTF-8. Thread-safe.
absl::StatusOr<std::string> MessageToJson(const google::protobuf::Message& message);

// Reads the fields of `message` from a JSON object, and ignores others. Returns INVALID_ARGUMENT if
// `json` is not one, or has another type for a field. Thread-safe.
absl::Status JsonToMessage(absl::string_view json, google::protobuf::Message* message);

}  // namespace spikeserve
