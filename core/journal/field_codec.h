// Converts values with fields (session_fields.h) to CBOR arrays of their members, and back.
//
// Arrays are compact, because they do not contain the names of the members. Numbers are exact. The
// writer streams, because it runs beside decisions. The reader builds a JSON document first,
// because it must check every value and runs only when a session is restored.
#pragma once

#include <array>
#include <cmath>
#include <concepts>
#include <cstdint>
#include <deque>
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
#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "absl/types/span.h"
#include "core/base/enum_names.h"
#include "core/base/fields.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/journal/cbor_writer.h"
#include "core/journal/session_fields.h"
#include "core/math/vector_view.h"
#include "nlohmann/json.hpp"

namespace spikeserve::codec {

using Json = nlohmann::json;

// Writes values as CBOR.
class Writer {
 public:
  // `out` must outlive the writer.
  explicit Writer(std::string* out) : cbor_(out) {}

  // Starts a document: an array of `format` and one value, which the caller writes next.
  void Begin(absl::string_view format) {
    cbor_.Array(2);
    cbor_.Text(format);
  }

  void Write(bool value) { cbor_.Bool(value); }
  void Write(float value) { cbor_.Float(value); }
  void Write(double value) { cbor_.Double(value); }
  void Write(const std::string& value) { cbor_.Text(value); }

  template <std::integral T>
  void Write(T value) {
    if constexpr (std::is_signed_v<T>) {
      cbor_.Signed(value);
    } else {
      cbor_.Unsigned(value);
    }
  }

  template <typename T>
  requires NamedEnum<T>
  void Write(T value) { cbor_.Text(ToString(value)); }

  template <typename T, size_t N>
  void Write(const std::array<T, N>& values) {
    WriteAll(values);
  }
  template <typename T>
  void Write(const std::vector<T>& values) {
    WriteAll(values);
  }
  template <typename T>
  void Write(const std::deque<T>& values) {
    WriteAll(values);
  }
  template <typename T>
  void Write(absl::Span<const T> values) {
    WriteAll(values);
  }
  template <typename T>
  void Write(const Eigen::VectorX<T>& values) {
    WriteAll(values);
  }

  void Write(const History& history) {
    cbor_.Array(history.size());
    Action action;
    for (size_t i = 0; i < history.size(); ++i) {
      cbor_.Array(3);
      Write(history.return_to_go(i));
      Write(history.observation(i));
      history.action(i, &action);
      Write(action);
    }
  }

  void Write(const std::map<std::string, std::string>& values) {
    cbor_.Map(values.size());
    for (const auto& [key, value] : values) {
      cbor_.Text(key);
      cbor_.Text(value);
    }
  }

  template <typename T>
  void Write(const std::optional<T>& value) {
    value.has_value() ? Write(*value) : cbor_.Null();
  }
  template <typename T>
  void Write(const std::shared_ptr<const T>& value) {
    value != nullptr ? Write(*value) : cbor_.Null();
  }

  template <HasFields T>
  void Write(const T& value) {
    size_t fields = 0;
    size_t more = 0;
    const auto write = [&](const char*, const auto& member) { Write(member); };
    VisitFields(value, [&](const char*, const auto&) { ++fields; });
    if constexpr (MayHaveMoreFields<const T>) more = MoreFields(value);
    cbor_.Array(fields + more);
    VisitFields(value, write);
    if constexpr (MayHaveMoreFields<const T>) {
      VisitMoreFields(value, [&](const char*, const auto& member) {
        if (more == 0) return;
        --more;
        Write(member);
      });
    }
  }

 private:
  template <typename Values>
  void WriteAll(const Values& values) {
    cbor_.Array(static_cast<size_t>(values.size()));
    for (const auto& value : values) Write(value);
  }

  CborWriter cbor_;
};

// Parses a document that Serialize() has written and returns its value. INVALID_ARGUMENT, which
// begins with `name`, if `bytes` is anything else or nests deeper than any session.
absl::StatusOr<Json> ParseDocument(const std::string& bytes, absl::string_view name,
                                   absl::string_view format);

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
    ReadAll(json, path, values);
  }
  template <typename T>
  void Read(const Json& json, const std::string& path, std::deque<T>& values) {
    ReadAll(json, path, values);
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
    size_t more = 0;
    VisitFields(value, [&](const char*, auto&) { ++fields; });
    if constexpr (MayHaveMoreFields<T>) {
      VisitMoreFields(value, [&](const char*, auto&) { ++more; });
    }
    if (!json.is_array() || json.size() < fields || json.size() > fields + more) {
      const std::string to_more = more > 0 ? absl::StrCat(" to ", fields + more) : "";
      return Fail(path, absl::StrCat("an array of ", fields, to_more), json);
    }
    size_t i = 0;
    const auto read = [&](const char* name, auto& member) {
      if (i < json.size()) Read(json[i++], absl::StrCat(path, ".", name), member);
    };
    VisitFields(value, read);
    if constexpr (MayHaveMoreFields<T>) {
      VisitMoreFields(value, [&](const char* name, auto& member) {
        if (i < json.size()) read(name, member);
      });
    }
  }

 private:
  template <typename Values>
  void ReadAll(const Json& json, const std::string& path, Values& values) {
    if (!json.is_array()) return Fail(path, "an array", json);
    values.resize(json.size());
    for (size_t i = 0; i < json.size(); ++i) {
      Read(json[i], absl::StrCat(path, "[", i, "]"), values[i]);
    }
  }
  void Fail(const std::string& path, absl::string_view expected, const Json& received) {
    status_.Update(InvalidArgument(path, expected, Describe(received)));
  }

  absl::Status status_;
};

// Returns the document of a value: an array of `format` and the value.
template <HasFields T>
std::string Serialize(absl::string_view format, const T& value) {
  std::string bytes;
  bytes.reserve(256);
  Writer writer(&bytes);
  writer.Begin(format);
  writer.Write(value);
  return bytes;
}

// Returns the value of a document, equal bit for bit. INVALID_ARGUMENT, which begins with `name`,
// if `bytes` is anything else.
template <HasFields T>
absl::StatusOr<T> Parse(const std::string& bytes, absl::string_view name,
                        absl::string_view format) {
  const absl::StatusOr<Json> json = ParseDocument(bytes, name, format);
  if (!json.ok()) return json.status();
  T value;
  Reader reader;
  reader.Read(*json, std::string(name), value);
  if (!reader.status().ok()) return reader.status();
  return value;
}

}  // namespace spikeserve::codec
