// Messages as JSON.
#ifndef PROTO_JSON_H_
#define PROTO_JSON_H_

#include <google/protobuf/message.h>

#include <string>

#include "absl/status/statusor.h"

namespace spikeserve {

// proto3's JSON mapping: the fields' names as in the .proto file, fields of value 0 included,
// 64-bit integers as strings. INTERNAL where protobuf refuses, as for text that is not UTF-8.
// Thread-safe.
absl::StatusOr<std::string> MessageToJson(const google::protobuf::Message& message);

}  // namespace spikeserve

#endif  // PROTO_JSON_H_
