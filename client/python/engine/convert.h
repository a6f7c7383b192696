// Converts between Python's objects and the values of core: arrays, errors and settings.
//
// The caller holds Python's global interpreter lock.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <initializer_list>
#include <memory>
#include <optional>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/agent/session_request.h"

namespace spikeserve {

// Raises the Python exception of an error: ValueError for INVALID_ARGUMENT, FileNotFoundError for
// NOT_FOUND, RuntimeError otherwise. Its text is the message of `status`.
[[noreturn]] void Raise(const absl::Status& status);

// Returns the value, or raises the exception of the error.
template <typename T>
T ValueOrRaise(absl::StatusOr<T> value) {
  if (!value.ok()) Raise(value.status());
  return *std::move(value);
}

template <typename Number>
using InputArray = nanobind::ndarray<const Number, nanobind::c_contig, nanobind::device::cpu>;

// Converts a number, a sequence or an array to an array of float32 or float64 numbers. Copies only
// if the type or the layout differs. Raises ValueError, which names `field`, unless the array has
// `dimensions` dimensions.
template <typename Number>
InputArray<Number> ToArray(const char* field, nanobind::handle value, size_t dimensions);

// Moves `values` into a new NumPy array.
template <typename Number>
nanobind::object ToNumpy(std::vector<Number> values, std::initializer_list<size_t> shape) {
  auto owned = std::make_unique<std::vector<Number>>(std::move(values));
  Number* const data = owned->data();
  const nanobind::capsule owner(owned.release(), [](void* vector) noexcept {
    delete static_cast<std::vector<Number>*>(vector);
  });
  return nanobind::cast(nanobind::ndarray<nanobind::numpy, Number>(data, shape, owner));
}

// Moves `values` into a new NumPy array of one dimension.
template <typename Number>
nanobind::object ToNumpy(std::vector<Number> values) {
  const size_t size = values.size();
  return ToNumpy(std::move(values), {size});
}

// Reads the attributes of a `Learning`, of this package or of the client. A missing attribute is
// absent.
LearningRequest ToLearningRequest(nanobind::handle learning);

}  // namespace spikeserve
