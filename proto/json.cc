#include "proto/json.h"

#include <google/protobuf/util/json_util.h>

#include <array>
#include <charconv>
#include <map>
#include <utility>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

using Json = nlohmann::ordered_json;
using Field = google::protobuf::FieldDescriptor;

// Converts the fields of one message.
struct Writer {
  const google::protobuf::Message& message;
  const Numbers numbers;
  const Absent absent;
  const google::protobuf::Reflection& get = *message.GetReflection();

  // The mapping has the shortest decimals of a float.
  Json Decimal(float number) const {
    if (numbers == Numbers::kExact) return number;
    std::array<char, 32> text = {};
    double decimal = 0.0;
    const char* const end = std::to_chars(text.begin(), text.end(), number).ptr;
    std::from_chars(text.begin(), end, decimal);
    return decimal;
  }

  Json Integer(auto number) const {
    return numbers == Numbers::kExact ? Json(number) : Json(absl::StrCat(number));
  }

  // Returns the value of a field, or its element `i` if it is repeated.
  Json Value(const Field* field, int i) const {
    const bool one = !field->is_repeated();
    switch (field->cpp_type()) {
      case Field::CPPTYPE_BOOL:
        return one ? get.GetBool(message, field) : get.GetRepeatedBool(message, field, i);
      case Field::CPPTYPE_INT32:
        return one ? get.GetInt32(message, field) : get.GetRepeatedInt32(message, field, i);
      case Field::CPPTYPE_UINT32:
        return one ? get.GetUInt32(message, field) : get.GetRepeatedUInt32(message, field, i);
      case Field::CPPTYPE_INT64:
        return Integer(one ? get.GetInt64(message, field)
                           : get.GetRepeatedInt64(message, field, i));
      case Field::CPPTYPE_UINT64:
        return Integer(one ? get.GetUInt64(message, field)
                           : get.GetRepeatedUInt64(message, field, i));
      case Field::CPPTYPE_FLOAT:
        return Decimal(one ? get.GetFloat(message, field)
                           : get.GetRepeatedFloat(message, field, i));
      case Field::CPPTYPE_DOUBLE:
        return one ? get.GetDouble(message, field) : get.GetRepeatedDouble(message, field, i);
      case Field::CPPTYPE_ENUM:
        return (one ? get.GetEnum(message, field) : get.GetRepeatedEnum(message, field, i))->name();
      case Field::CPPTYPE_STRING:
        return one ? get.GetString(message, field) : get.GetRepeatedString(message, field, i);
      case Field::CPPTYPE_MESSAGE:
        return MessageToFields(
            one ? get.GetMessage(message, field) : get.GetRepeatedMessage(message, field, i),
            numbers, absent);
    }
    return {};  // unreachable: the switch handles every type
  }

  Json Map(const Field* field) const {
    std::map<std::string, Json> sorted;
    for (int i = 0; i < get.FieldSize(message, field); ++i) {
      const Json entry = Value(field, i);
      sorted.emplace(entry["key"].get<std::string>(), entry["value"]);
    }
    return sorted;
  }

  Json List(const Field* field) const {
    Json list = Json::array();
    for (int i = 0; i < get.FieldSize(message, field); ++i) list.push_back(Value(field, i));
    return list;
  }
};

}  // namespace

Json MessageToFields(const google::protobuf::Message& message, Numbers numbers, Absent absent) {
  const Writer writer = {message, numbers, absent};
  Json json = Json::object();
  for (int i = 0; i < message.GetDescriptor()->field_count(); ++i) {
    const Field* const field = message.GetDescriptor()->field(i);
    if (field->is_repeated()) {
      json[field->name()] = field->is_map() ? writer.Map(field) : writer.List(field);
    } else if (!field->has_presence() || writer.get.HasField(message, field)) {
      json[field->name()] = writer.Value(field, /*i=*/0);
    } else if (absent == Absent::kNull) {
      json[field->name()] = nullptr;
    }
  }
  return json;
}

std::string JsonText(const Json& json) {
  return json.dump(/*indent=*/-1, /*indent_char=*/' ', /*ensure_ascii=*/false,
                   Json::error_handler_t::replace);
}

absl::Status JsonToMessage(absl::string_view json, google::protobuf::Message* message) {
  google::protobuf::util::JsonParseOptions options;
  options.ignore_unknown_fields = true;
  const auto status =
      google::protobuf::util::JsonStringToMessage({json.data(), json.size()}, message, options);
  return status.ok() ? absl::OkStatus() : absl::InvalidArgumentError(status.ToString());
}

}  // namespace spikeserve
