// Reads the members of JSON objects into typed values, strictly: nothing is guessed, and every
// error names the field, the expected value and the received value.
//
//   JsonObject share("shares[0]", json);
//   share.Required("version", &version, 1);   // an integer of at least 1
//   share.Optional("note", &note);            // a string, or absent
//   if (auto status = share.Finish(); !status.ok()) return status;
//
// To make a type T readable, declare `absl::Status ReadJson(absl::string_view field, const
// nlohmann::json& value, T* result)` in its namespace.
//
// A JsonObject is not thread-safe; the functions are.
#pragma once

#include <cmath>
#include <concepts>
#include <cstdint>
#include <limits>
#include <map>
#include <optional>
#include <set>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "core/base/enum_names.h"
#include "core/base/json.h"
#include "nlohmann/json.hpp"

namespace spikeserve {

// Returns INVALID_ARGUMENT with the message "`field`: expected `expected`, received ...".
absl::Status UnexpectedJson(absl::string_view field, absl::string_view expected,
                            const nlohmann::json& received);

// Stores `value` in `result`. INVALID_ARGUMENT if it has another type or is out of range; `result`
// may be partly written then.
absl::Status ReadJson(absl::string_view field, const nlohmann::json& value, bool* result);
absl::Status ReadJson(absl::string_view field, const nlohmann::json& value, std::string* result);
absl::Status ReadJson(absl::string_view field, const nlohmann::json& value, nlohmann::json* result);
// Reads a number; for a float, one that fits float32. Accepts NaN, which CBOR can contain.
absl::Status ReadJson(absl::string_view field, const nlohmann::json& value, double* result);
absl::Status ReadJson(absl::string_view field, const nlohmann::json& value, float* result);
// Stores an integer from `least` to `greatest` in `bits`, in two's complement if it is negative.
absl::Status ReadJsonInteger(absl::string_view field, const nlohmann::json& value, int64_t least,
                             uint64_t greatest, uint64_t* bits);

template <typename T>
concept JsonInteger = std::integral<T> && !std::same_as<T, bool>;

template <JsonInteger T>
absl::Status ReadJson(absl::string_view field, const nlohmann::json& value, T* result,
                      T least = std::numeric_limits<T>::min(),
                      T greatest = std::numeric_limits<T>::max()) {
  uint64_t bits = 0;
  absl::Status status = ReadJsonInteger(field, value, static_cast<int64_t>(least),
                                        static_cast<uint64_t>(greatest), &bits);
  if (status.ok()) *result = static_cast<T>(bits);
  return status;
}

template <NamedEnum Enum>
absl::Status ReadJson(absl::string_view field, const nlohmann::json& value, Enum* result) {
  std::string name;
  if (auto status = ReadJson(field, value, &name); !status.ok()) return status;
  const auto parsed = ParseEnum<Enum>(field, name);
  if (parsed.ok()) *result = *parsed;
  return parsed.status();
}

template <typename T>
absl::Status ReadJson(absl::string_view field, const nlohmann::json& value,
                      std::optional<T>* result) {
  return ReadJson(field, value, &result->emplace());
}

template <typename T>
absl::Status ReadJson(absl::string_view field, const nlohmann::json& value,
                      std::vector<T>* result) {
  if (!value.is_array()) return UnexpectedJson(field, "an array", value);
  result->resize(value.size());
  for (size_t i = 0; i < value.size(); ++i) {
    if constexpr (std::is_arithmetic_v<T> && !std::is_same_v<T, bool>) {
      // Arrays of numbers are long, so the name of an element is built only if there is an error.
      if (ReadJson(field, value[i], &(*result)[i]).ok()) continue;
    }
    auto status = ReadJson(absl::StrCat(field, "[", i, "]"), value[i], &(*result)[i]);
    if (!status.ok()) return status;
  }
  return absl::OkStatus();
}

// Reads an object whose members all have one type.
template <typename T>
absl::Status ReadJson(absl::string_view field, const nlohmann::json& value,
                      std::map<std::string, T>* result) {
  if (!value.is_object()) return UnexpectedJson(field, "an object", value);
  for (const auto& [key, member] : value.items()) {
    auto status = ReadJson(absl::StrCat(field, ".", key), member, &(*result)[key]);
    if (!status.ok()) return status;
  }
  return absl::OkStatus();
}

// Reads one object, member by member. Stores the first error.
class JsonObject {
 public:
  // `value` must outlive this object. Errors name a member "`field`.KEY", or "KEY" if `field` is
  // empty.
  JsonObject(absl::string_view field, const nlohmann::json& value);

  // Reads the member `key`; its absence is an error. Does nothing after the first error. `bounds`
  // are the least and the greatest integer allowed, as for ReadJson.
  template <typename T, typename... Bounds>
  void Required(const char* key, T* result, Bounds... bounds) {
    if (const nlohmann::json* member = Find(key, /*required=*/true)) {
      status_.Update(ReadJson(Path(key), *member, result, static_cast<T>(bounds)...));
    }
  }

  // As Required, but leaves `result` unchanged if there is no such member.
  template <typename T, typename... Bounds>
  void Optional(const char* key, T* result, Bounds... bounds) {
    if (const nlohmann::json* member = Find(key, /*required=*/false)) {
      status_.Update(ReadJson(Path(key), *member, result, static_cast<T>(bounds)...));
    }
  }

  // Accepts members that are not read, for files that other programs write.
  void AllowOtherKeys() { allow_other_keys_ = true; }

  // Returns the first error. A member that was not read is an error, unless AllowOtherKeys was
  // called.
  absl::Status Finish();

  const absl::Status& status() const { return status_; }

 private:
  std::string Path(const char* key) const {
    return field_.empty() ? key : absl::StrCat(field_, ".", key);
  }

  std::string Prefix() const { return field_.empty() ? "" : absl::StrCat(field_, ": "); }

  // Returns the member, or null if there is none or an error has occurred. If it is `required`, its
  // absence is an error.
  const nlohmann::json* Find(const char* key, bool required);

  const std::string field_;
  const nlohmann::json& object_;
  std::set<std::string> read_;
  bool allow_other_keys_ = false;
  absl::Status status_;
};

}  // namespace spikeserve
