#include "client/python/engine/convert.h"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include <stdexcept>
#include <string>
#include <type_traits>

#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

namespace nb = nanobind;

std::optional<double> Number(nb::handle object, const char* name) {
  const nb::object value = nb::getattr(object, name, nb::none());
  return value.is_none() ? std::nullopt : std::optional(nb::cast<double>(value));
}

std::string Text(nb::handle object, const char* name) {
  return nb::cast<std::string>(nb::getattr(object, name, nb::str("")));
}

}  // namespace

void Raise(const absl::Status& status) {
  const std::string message(status.message());
  switch (status.code()) {
    case absl::StatusCode::kInvalidArgument:
      throw nb::value_error(message.c_str());
    case absl::StatusCode::kNotFound:
      PyErr_SetString(PyExc_FileNotFoundError, message.c_str());
      throw nb::python_error();
    default:
      throw std::runtime_error(message);
  }
}

template <typename Number>
InputArray<Number> ToArray(const char* field, nb::handle value, size_t dimensions) {
  InputArray<Number> array;
  if (!nb::try_cast(value, array, /*convert=*/false)) {
    const char* const dtype = std::is_same_v<Number, float> ? "float32" : "float64";
    const nb::object converted = nb::module_::import_("numpy").attr("asarray")(
        value, nb::arg("dtype") = dtype, nb::arg("order") = "C");
    array = nb::cast<InputArray<Number>>(converted);
  }
  if (array.ndim() == dimensions) return array;
  std::string shape;
  for (size_t i = 0; i < array.ndim(); ++i)
    absl::StrAppend(&shape, i > 0 ? ", " : "", array.shape(i));
  const char* const expected = dimensions == 1 ? "one dimension" : "two dimensions";
  throw nb::value_error(
      absl::StrCat(field, ": expected ", expected, ", received shape (", shape, ")").c_str());
}

template InputArray<float> ToArray(const char*, nb::handle, size_t);
template InputArray<double> ToArray(const char*, nb::handle, size_t);

LearningRequest ToLearningRequest(nb::handle learning) {
  LearningRequest request;
  if (const std::string scope = Text(learning, "scope"); scope == "FLEET") {
    request.scope = Scope::kFleet;
  } else if (!scope.empty() && scope != "SESSION") {
    throw nb::value_error(
        absl::StrCat("learning.scope: expected SESSION or FLEET, received ", scope).c_str());
  }
  request.rule = Text(learning, "rule");
  request.modulator = Text(learning, "modulator");
  request.learning_rate = Number(learning, "learning_rate");
  request.trace_decay = Number(learning, "trace_decay");
  request.discount = Number(learning, "discount");
  request.clip = Number(learning, "clip");
  request.max_drift = Number(learning, "max_drift");
  request.guard_margin = Number(learning, "guard_margin");
  request.verdict_seconds = Number(learning, "verdict_seconds");
  return request;
}

}  // namespace spikeserve
