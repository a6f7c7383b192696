#include "core/base/json_object.h"

#include "core/base/status.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

}  // namespace

absl::Status UnexpectedJson(absl::string_view field, absl::string_view expected,
                            const Json& received) {
  return InvalidArgument(field, expected, Describe(received));
}

absl::Status ReadJson(absl::string_view field, const Json& value, bool* result) {
  if (!value.is_boolean()) return UnexpectedJson(field, "true or false", value);
  *result = value.get<bool>();
  return absl::OkStatus();
}

absl::Status ReadJson(absl::string_view field, const Json& value, std::string* result) {
  if (!value.is_string()) return UnexpectedJson(field, "a string", value);
  *result = value.get_ref<const std::string&>();
  return absl::OkStatus();
}

absl::Status ReadJson(absl::string_view /*field*/, const Json& value, Json* result) {
  *result = value;
  return absl::OkStatus();
}

absl::Status ReadJson(absl::string_view field, const Json& value, double* result) {
  if (!value.is_number()) return UnexpectedJson(field, "a number", value);
  *result = value.get<double>();
  return absl::OkStatus();
}

absl::Status ReadJson(absl::string_view field, const Json& value, float* result) {
  constexpr double kGreatest = std::numeric_limits<float>::max();
  if (!value.is_number() || std::abs(value.get<double>()) > kGreatest) {
    return UnexpectedJson(field, "a number that fits float32", value);
  }
  *result = value.get<float>();
  return absl::OkStatus();
}

absl::Status ReadJsonInteger(absl::string_view field, const Json& value, int64_t least,
                             uint64_t greatest, uint64_t* bits) {
  const auto within = [&] {
    if (value.is_number_unsigned()) {
      const auto number = value.get<uint64_t>();
      return number <= greatest && (least < 0 || number >= static_cast<uint64_t>(least));
    }
    if (!value.is_number_integer()) return false;
    const auto number = value.get<int64_t>();
    return number >= least && (number < 0 || static_cast<uint64_t>(number) <= greatest);
  };
  if (within()) {
    *bits = value.is_number_unsigned() ? value.get<uint64_t>()
                                       : static_cast<uint64_t>(value.get<int64_t>());
    return absl::OkStatus();
  }
  const bool bounded = greatest < static_cast<uint64_t>(std::numeric_limits<int64_t>::max());
  return UnexpectedJson(field,
                        bounded ? absl::StrCat("an integer from ", least, " to ", greatest)
                        : least > std::numeric_limits<int64_t>::min()
                            ? absl::StrCat("an integer of at least ", least)
                            : "an integer",
                        value);
}

JsonObject::JsonObject(absl::string_view field, const Json& value) : field_(field), object_(value) {
  if (!value.is_object()) status_ = UnexpectedJson(field, "an object", value);
}

absl::Status JsonObject::Finish() {
  if (!status_.ok() || allow_other_keys_) return status_;
  for (const auto& member : object_.items()) {
    if (read_.contains(member.key())) continue;
    status_ = absl::InvalidArgumentError(
        absl::StrCat(Prefix(), "expected no other keys, received ", Quoted(member.key())));
    break;
  }
  return status_;
}

const Json* JsonObject::Find(const char* key, bool required) {
  read_.insert(key);
  if (!status_.ok()) return nullptr;
  const auto found = object_.find(key);
  if (found != object_.end()) return &*found;
  if (required) {
    status_ = absl::InvalidArgumentError(
        absl::StrCat(Prefix(), "expected key ", Quoted(key), ", received none"));
  }
  return nullptr;
}

}  // namespace spikeserve
