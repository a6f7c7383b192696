// What Minari's layout needs of HDF5: groups, attributes and one- or two-dimensional arrays.
//
// The HDF5 library is not thread-safe: one thread of a process at a time. Errors name the path and
// the object within.
#ifndef TRAIN_DATA_HDF5_FILE_H_
#define TRAIN_DATA_HDF5_FILE_H_

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/types/optional.h"
#include "absl/types/span.h"

namespace spikeserve {

// Rows of numbers: [rows], or [rows, columns].
struct Hdf5Shape {
  int64_t rows = 0;
  absl::optional<int64_t> columns;  // nothing where there is one dimension

  int64_t size() const { return rows * columns.value_or(1); }
};

template <typename T>
struct Hdf5Array {
  Hdf5Shape shape;
  std::vector<T> values;  // [shape.size()], row-major
};

class Hdf5File {
 public:
  // A new file in place of any old one.
  static absl::StatusOr<Hdf5File> Create(const std::string& path);
  static absl::StatusOr<Hdf5File> Open(const std::string& path);

  Hdf5File(Hdf5File&& other) noexcept;
  Hdf5File& operator=(Hdf5File&& other) = delete;
  ~Hdf5File();

  // Names are paths within the file, such as "episode_0/observations".
  absl::Status CreateGroup(const std::string& name);
  bool Exists(const std::string& name) const;

  absl::Status WriteAttribute(const std::string& object, const std::string& name, int64_t value);
  absl::Status WriteAttribute(const std::string& object, const std::string& name, double value);
  absl::Status WriteAttribute(const std::string& object, const std::string& name,
                              const std::string& value);
  // NOT_FOUND if there is none of that name; INVALID_ARGUMENT if it is of another type.
  absl::StatusOr<int64_t> ReadInteger(const std::string& object, const std::string& name) const;
  absl::StatusOr<double> ReadDouble(const std::string& object, const std::string& name) const;
  absl::StatusOr<std::string> ReadString(const std::string& object, const std::string& name) const;

  // T: float, double, int64_t, or uint8_t for NumPy's bool. REQUIRES: values is [shape.size()].
  template <typename T>
  absl::Status Write(const std::string& name, const Hdf5Shape& shape, absl::Span<const T> values);
  // Numbers of any width, converted to T (float, double, int64_t). More than two dimensions are one
  // row of columns for each of the first.
  template <typename T>
  absl::StatusOr<Hdf5Array<T>> Read(const std::string& name) const;
  // NumPy's bool, or integers.
  absl::StatusOr<std::vector<bool>> ReadBools(const std::string& name) const;

  // Flushes and closes; the object is empty afterwards.
  absl::Status Close();

 private:
  Hdf5File(std::string path, int64_t id) : path_(std::move(path)), id_(id) {}
  // `type` is a native number's, `value` points to one.
  absl::Status WriteNumber(const std::string& object, const std::string& name, int64_t type,
                           const void* value);
  absl::Status ReadNumber(const std::string& object, const std::string& name, int64_t type,
                          void* value) const;
  absl::Status Failed(absl::string_view action, const std::string& name) const;

  std::string path_;
  int64_t id_;  // hid_t; -1 when closed
};

}  // namespace spikeserve

#endif  // TRAIN_DATA_HDF5_FILE_H_
