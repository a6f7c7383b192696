#include "server/services/finite_response.h"

#include <google/protobuf/descriptor.h>
#include <google/protobuf/reflection.h>

#include <cmath>
#include <type_traits>
#include <vector>

#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

using google::protobuf::FieldDescriptor;
using google::protobuf::Message;
using google::protobuf::Reflection;

// Returns the name of the first field that is not finite, with those above it; empty: none.
std::string FirstNonFinite(const Message& message);

std::string NonFiniteMessage(const Message& message, const FieldDescriptor* field) {
  const Reflection& reflection = *message.GetReflection();
  if (!field->is_repeated()) return FirstNonFinite(reflection.GetMessage(message, field));
  for (int i = 0; i < reflection.FieldSize(message, field); ++i) {
    const std::string below = FirstNonFinite(reflection.GetRepeatedMessage(message, field, i));
    if (!below.empty()) return below;
  }
  return "";
}

// `Number` is the type of the field.
template <typename Number>
bool HoldsNonFinite(const Message& message, const FieldDescriptor* field) {
  const Reflection& reflection = *message.GetReflection();
  if (field->is_repeated()) {
    for (const Number number : reflection.GetRepeatedFieldRef<Number>(message, field)) {
      if (!std::isfinite(number)) return true;
    }
    return false;
  }
  if constexpr (std::is_same_v<Number, float>) {
    return !std::isfinite(reflection.GetFloat(message, field));
  } else {
    return !std::isfinite(reflection.GetDouble(message, field));
  }
}

std::string FirstNonFinite(const Message& message) {
  std::vector<const FieldDescriptor*> fields;
  message.GetReflection()->ListFields(message, &fields);
  for (const FieldDescriptor* field : fields) {
    const std::string name(field->name());
    if (field->cpp_type() == FieldDescriptor::CPPTYPE_MESSAGE) {
      const std::string below = NonFiniteMessage(message, field);
      if (!below.empty()) return absl::StrCat(name, ".", below);
    } else if (field->cpp_type() == FieldDescriptor::CPPTYPE_FLOAT) {
      if (HoldsNonFinite<float>(message, field)) return name;
    } else if (field->cpp_type() == FieldDescriptor::CPPTYPE_DOUBLE) {
      if (HoldsNonFinite<double>(message, field)) return name;
    }
  }
  return "";
}

}  // namespace

absl::Status CheckFinite(const Message& response, const std::string& policy) {
  const std::string field = FirstNonFinite(response);
  if (field.empty()) return absl::OkStatus();
  return absl::InternalError(absl::StrCat(field,
                                          ": expected finite numbers, received NaN or infinity",
                                          policy.empty() ? "" : " of policy ", policy));
}

std::string TextOf(const Message& message, const std::string& name) {
  const auto* field = message.GetDescriptor()->FindFieldByName(name);
  if (field == nullptr || field->is_repeated() ||
      field->cpp_type() != FieldDescriptor::CPPTYPE_STRING) {
    return "";
  }
  return message.GetReflection()->GetString(message, field);
}

}  // namespace spikeserve
