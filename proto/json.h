// Converts protobuf messages to JSON and back.
#pragma once

#include <google/protobuf/message.h>

#include <string>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "nlohmann/json.hpp"

namespace spikeserve {

enum class Numbers {
  kMapped,  // as the mapping says: 64-bit integers as texts, floats by their shortest decimals
  kExact,   // as numbers
};
enum class Absent { kLeftOut, kNull };

// Returns `message` in the proto3 JSON mapping, with the field names of the .proto file and with
// fields that are 0 or empty. Optional fields that are not set are left out, as the mapping says,
// or null. NaN and infinity become null when the result is printed. REQUIRES: no field of bytes,
// and maps by texts. Thread-safe.
nlohmann::ordered_json MessageToFields(const google::protobuf::Message& message,
                                       Numbers numbers = Numbers::kMapped,
                                       Absent absent = Absent::kLeftOut);

// The same for the messages of a repeated field.
template <typename Messages>
nlohmann::ordered_json MessagesToList(const Messages& messages,
                                      Numbers numbers = Numbers::kMapped) {
  auto list = nlohmann::ordered_json::array();
  for (const auto& message : messages) list.push_back(MessageToFields(message, numbers));
  return list;
}

// Returns the text of `json`, also if it holds texts that are not UTF-8.
std::string JsonText(const nlohmann::ordered_json& json);

// Reads the fields of `message` from a JSON object, and ignores others. Returns INVALID_ARGUMENT if
// `json` is not one, or has another type for a field. Thread-safe.
absl::Status JsonToMessage(absl::string_view json, google::protobuf::Message* message);

}  // namespace spikeserve
