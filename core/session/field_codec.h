// Converts values with fields (session_fields.h) to JSON arrays of their members, and back.
//
// Arrays are compact, because they do not contain the names of the members. Numbers are exact,
// because CBOR keeps the bits of a double and every float is a double.
#ifndef CORE_SESSION_FIELD_CODEC_H_
#define CORE_SESSION_FIELD_CODEC_H_

#include <array>
#include <cmath>
#include <concepts>
#include <cstdint>
#include <limits>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#include "Eigen/Core"
#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "core/base/enum_names.h"
#include "core/base/json.h"
#include "core/math/vector_view.h"
#include "core/session/session_fields.h"
#include "nlohmann/json.hpp"

namespace spikeserve::codec {

using Json = nlohmann::json;

// Write() returns the JSON form of a value.

template <typename T>
Json Write(const T& value) {
  return value;
}

template <typename T>
Json Write(const Eigen::VectorX<T>& values) {
  return std::vector<T>(values.begin(), values.end());
}

template <typename T>
requires NamedEnum<T> Json Write(const T& value) { return std::string(ToString(value)); }

template <HasFields T>
Json Write(const T& value);

inline Json Write(const History& history) {
  Json json = Json::array();
  for (size_t i = 0; i < history.size(); ++i) json.push_back(Write(history.at(i)));
  return json;
}

template <typename T>
Json Write(const std::optional<T>& value) {
  return value.has_value() ? Write(*value) : Json();
}

template <typename T>
Json Write(const std::shared_ptr<const T>& value) {
  return value != nullptr ? Write(*value) : Json();
}

template <HasFields T>
Json Write(const T& value) {
  Json json = Json::array();
  VisitFields(value, [&](const char*, const auto& member) { json.push_back(Write(member)); });
  return json;
}

// Reads values from JSON. Stores the first error, which names the path of the wrong value.
class Reader {
 public:
  const absl::Status& status() const { return status_; }

  void Read(const Json& json, const std::string& path, std::string& value) {
    if (!json.is_string()) return Fail(path, "a string", json);
    value = json.get<std::string>();
  }

  void Read(const Json& json, const std::string& path, bool& value) {
    if (!json.is_boolean()) return Fail(path, "a boolean", json);
    value = json.get<bool>();
  }

  template <typename T>
  requires NamedEnum<T>
  void Read(const Json& json, const std::string& path, T& value) {
    if (!json.is_string()) return Fail(path, "a string", json);
    const auto parsed = ParseEnum<T>(path, json.get_ref<const std::string&>());
    status_.Update(parsed.status());
    if (parsed.ok()) value = *parsed;
  }

  template <std::integral T>
  void Read(const Json& json, const std::string& path, T& value) {
    const bool fits = json.is_number_unsigned()  ? std::in_range<T>(json.get<uint64_t>())
                      : json.is_number_integer() ? std::in_range<T>(json.get<int64_t>())
                                                 : false;
    if (!fits) return Fail(path, absl::StrCat("an integer of ", 8 * sizeof(T), " bits"), json);
    value = json.get<T>();
  }

  template <std::floating_point T>
  void Read(const Json& json, const std::string& path, T& value) {
    const double number = json.is_number_float() ? json.get<double>() : std::nan("");
    if (!(std::abs(number) <= static_cast<double>(std::numeric_limits<T>::max()))) {
      return Fail(path, "a finite floating-point number", json);
    }
    value = static_cast<T>(number);
  }

  template <typename T, size_t N>
  void Read(const Json& json, const std::string& path, std::array<T, N>& values) {
    if (!json.is_array() || json.size() != N) {
      return Fail(path, absl::StrCat("an array of ", N), json);
    }
    for (size_t i = 0; i < N; ++i) Read(json[i], absl::StrCat(path, "[", i, "]"), values[i]);
  }

  template <typename T>
  void Read(const Json& json, const std::string& path, std::vector<T>& values) {
    if (!json.is_array()) return Fail(path, "an array", json);
    values.resize(json.size());
    for (size_t i = 0; i < json.size(); ++i) {
      Read(json[i], absl::StrCat(path, "[", i, "]"), values[i]);
    }
  }

  template <typename T>
  void Read(const Json& json, const std::string& path, Eigen::VectorX<T>& values) {
    std::vector<T> read;
    Read(json, path, read);
    values = AsVector(read);
  }

  void Read(const Json& json, const std::string& path, History& history) {
    std::vector<Timestep> timesteps;
    Read(json, path, timesteps);
    for (size_t i = 0; i < timesteps.size(); ++i) {
      const auto& [return_to_go, observation, action] = timesteps[i];
      if (observation.size() != timesteps[0].observation.size() ||
          action.continuous.size() != timesteps[0].action.continuous.size()) {
        return Fail(absl::StrCat(path, "[", i, "]"), "as many numbers as timestep 0 has", json[i]);
      }
      history.Append(return_to_go, observation, action, timesteps.size());
    }
  }

  void Read(const Json& json, const std::string& path, std::map<std::string, std::string>& values) {
    if (!json.is_object()) return Fail(path, "a map", json);
    for (const auto& [key, value] : json.items()) Read(value, path, values[key]);
  }

  template <typename T>
  void Read(const Json& json, const std::string& path, std::optional<T>& value) {
    if (!json.is_null()) Read(json, path, value.emplace());
  }

  template <typename T>
  void Read(const Json& json, const std::string& path, std::shared_ptr<const T>& value) {
    if (json.is_null()) return;
    auto read = std::make_shared<T>();
    Read(json, path, *read);
    value = std::move(read);
  }

  template <HasFields T>
  void Read(const Json& json, const std::string& path, T& value) {
    size_t fields = 0;
    VisitFields(value, [&](const char*, auto&) { ++fields; });
    if (!json.is_array() || json.size() != fields) {
      return Fail(path, absl::StrCat("an array of ", fields), json);
    }
    size_t i = 0;
    VisitFields(value, [&](const char* name, auto& member) {
      Read(json[i++], absl::StrCat(path, ".", name), member);
    });
  }

 private:
  void Fail(const std::string& path, absl::string_view expected, const Json& received) {
    status_.Update(absl::InvalidArgumentError(
        absl::StrCat(path, ": expected ", expected, ", received ", Describe(received))));
  }

  absl::Status status_;
};

}  // namespace spikeserve::codec

#endif  // CORE_SESSION_FIELD_CODEC_H_
