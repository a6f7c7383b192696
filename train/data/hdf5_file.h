// Reads and writes the parts of HDF5 that Minari's layout needs: groups, attributes and arrays of
// one or two dimensions.
//
// Not thread-safe, like the HDF5 library: only one thread of a process may use it at a time. Errors
// name the file's path and the object in the file.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/types/optional.h"
#include "absl/types/span.h"

namespace spikeserve {

// The shape of an array: [rows], or [rows, columns].
struct Hdf5Shape {
  int64_t rows = 0;
  absl::optional<int64_t> columns;  // absent if the array has one dimension

  int64_t size() const { return rows * columns.value_or(1); }
};

template <typename T>
struct Hdf5Array {
  Hdf5Shape shape;
  std::vector<T> values;  // [shape.size()], row-major
};

class Hdf5File {
 public:
  // Creates a file and overwrites an existing one. Returns UNAVAILABLE if it cannot be written.
  static absl::StatusOr<Hdf5File> Create(const std::string& path);
  // Opens a file for reading. Returns NOT_FOUND if it cannot be read as HDF5.
  static absl::StatusOr<Hdf5File> Open(const std::string& path);

  Hdf5File(Hdf5File&& other) noexcept;
  Hdf5File& operator=(Hdf5File&& other) = delete;
  ~Hdf5File();

  // `name` is a path within the file, such as "episode_0/observations", here and below.
  absl::Status CreateGroup(const std::string& name);
  bool Exists(const std::string& name) const;

  absl::Status WriteAttribute(const std::string& object, const std::string& name, int64_t value);
  absl::Status WriteAttribute(const std::string& object, const std::string& name, double value);
  absl::Status WriteAttribute(const std::string& object, const std::string& name,
                              const std::string& value);
  // Reads an attribute. Returns NOT_FOUND if it does not exist, INVALID_ARGUMENT if it has another
  // type.
  absl::StatusOr<int64_t> ReadInteger(const std::string& object, const std::string& name) const;
  absl::StatusOr<double> ReadDouble(const std::string& object, const std::string& name) const;
  absl::StatusOr<std::string> ReadString(const std::string& object, const std::string& name) const;

  // Writes an array. T is float, double, int64_t, or uint8_t, which is stored as NumPy's bool.
  // REQUIRES: values is [shape.size()].
  template <typename T>
  absl::Status Write(const std::string& name, const Hdf5Shape& shape, absl::Span<const T> values);
  // Reads an array of numbers of any type and converts them to T: float, double or int64_t. An
  // array of more than two dimensions is flattened to [first dimension, product of the others].
  // Returns NOT_FOUND if it does not exist.
  template <typename T>
  absl::StatusOr<Hdf5Array<T>> Read(const std::string& name) const;
  // Reads an array of NumPy's bool type or of integers. Returns NOT_FOUND if it does not exist.
  absl::StatusOr<std::vector<bool>> ReadBools(const std::string& name) const;

  // Flushes and closes the file. Returns UNAVAILABLE if that fails. REQUIRES: nothing else is
  // called afterwards except the destructor.
  absl::Status Close();

 private:
  Hdf5File(std::string path, int64_t id) : path_(std::move(path)), id_(id) {}
  // `type` is the HDF5 identifier of a native number type; `value` points to a number of that type.
  absl::Status WriteNumber(const std::string& object, const std::string& name, int64_t type,
                           const void* value);
  absl::Status ReadNumber(const std::string& object, const std::string& name, int64_t type,
                          void* value) const;
  // Opens an array for reading. INVALID_ARGUMENT if its numbers are in another file.
  absl::StatusOr<int64_t> OpenArray(const std::string& name) const;
  absl::Status Failed(absl::string_view action, const std::string& name) const;

  std::string path_;
  int64_t id_;  // hid_t; -1 when closed
};

}  // namespace spikeserve
