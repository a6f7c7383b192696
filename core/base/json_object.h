// Reads the members of JSON objects into typed values, strictly: every error names the field, what
// was expected and what was received, and nothing is guessed.
//
//   JsonObject share("shares[0]", json);
//   share.Required("version", &version, 1);   // an integer of at least 1
//   share.Optional("note", &note);            // a string, or absent
//   if (auto status = share.Finish(); !status.ok()) return status;
//
// A type of your own becomes readable by an overload `absl::Status ReadJson(absl::string_view
// field, const nlohmann::json& value, T* result)` in its namespace. Not thread-safe.
#ifndef CORE_BASE_JSON_OBJECT_H_
#define CORE_BASE_JSON_OBJECT_H_

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

// INVALID_ARGUMENT: "`field`: expected `expected`, received ...".
absl::Status UnexpectedJson(absl::string_view field, absl::string_view expected,
                            const nlohmann::json& received);

// Each stores `value` in `result` and returns OK, or returns INVALID_ARGUMENT and leaves `result`
// as it was or partly read.
absl::Status ReadJson(absl::string_view field, const nlohmann::json& value, bool* result);
absl::Status ReadJson(absl::string_view field, const nlohmann::json& value, std::string* result);
absl::Status ReadJson(absl::string_view field, const nlohmann::json& value, nlohmann::json* result);
// A number; for a float, one that fits float32. CBOR also holds numbers that are not a number.
absl::Status ReadJson(absl::string_view field, const nlohmann::json& value, double* result);
absl::Status ReadJson(absl::string_view field, const nlohmann::json& value, float* result);
// An integer from `least` to `greatest`.
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
      // Arrays of numbers are long: their elements get a name only if there is an error to report.
      if (ReadJson(field, value[i], &(*result)[i]).ok()) continue;
    }
    auto status = ReadJson(absl::StrCat(field, "[", i, "]"), value[i], &(*result)[i]);
    if (!status.ok()) return status;
  }
  return absl::OkStatus();
}

// An object whose members are all values of one type.
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

class JsonObject {
 public:
  // `value` must outlive the reader. Members are named "`field`.KEY" in errors, or "KEY" if `field`
  // is empty.
  JsonObject(absl::string_view field, const nlohmann::json& value);

  // Reads the member `key`, which must be there. After the first error nothing more is read.
  // `bounds` are the least and the greatest integer allowed, as ReadJson takes them.
  template <typename T, typename... Bounds>
  void Required(const char* key, T* result, Bounds... bounds) {
    if (const nlohmann::json* member = Find(key, /*required=*/true)) {
      status_.Update(ReadJson(Path(key), *member, result, static_cast<T>(bounds)...));
    }
  }

  // As Required, but leaves `result` as it was if there is no such member.
  template <typename T, typename... Bounds>
  void Optional(const char* key, T* result, Bounds... bounds) {
    if (const nlohmann::json* member = Find(key, /*required=*/false)) {
      status_.Update(ReadJson(Path(key), *member, result, static_cast<T>(bounds)...));
    }
  }

  // Keeps members that nobody read from being an error, for files that others write.
  void AllowOtherKeys() { allow_other_keys_ = true; }

  // The first error; a member that was not read is one.
  absl::Status Finish();

  const absl::Status& status() const { return status_; }

 private:
  std::string Path(const char* key) const {
    return field_.empty() ? key : absl::StrCat(field_, ".", key);
  }

  std::string Prefix() const { return field_.empty() ? "" : absl::StrCat(field_, ": "); }

  // The member, or null. Reports a missing one if it is required.
  const nlohmann::json* Find(const char* key, bool required);

  const std::string field_;
  const nlohmann::json& object_;
  std::set<std::string> read_;
  bool allow_other_keys_ = false;
  absl::Status status_;
};

}  // namespace spikeserve

#endif  // CORE_BASE_JSON_OBJECT_H_
