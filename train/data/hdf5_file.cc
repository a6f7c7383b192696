#include "train/data/hdf5_file.h"

#include <hdf5.h>

#include <algorithm>
#include <optional>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

// Owns an identifier of the HDF5 library and releases it with `close`.
class Handle {
 public:
  Handle(hid_t id, herr_t (*close)(hid_t)) : id_(id), close_(close) {}
  Handle(const Handle&) = delete;
  Handle& operator=(const Handle&) = delete;
  ~Handle() {
    if (id_ >= 0) close_(id_);
  }
  operator hid_t() const { return id_; }  // NOLINT: implicit, to pass it to the library

 private:
  const hid_t id_;
  herr_t (*const close_)(hid_t);
};

// Creates the type that NumPy's bool is stored as: an enumeration over one byte.
hid_t MakeBoolType() {
  const hid_t type = H5Tenum_create(H5T_NATIVE_INT8);
  const int8_t no = 0, yes = 1;
  H5Tenum_insert(type, "FALSE", &no);
  H5Tenum_insert(type, "TRUE", &yes);
  return type;
}

template <typename T>
hid_t MemoryType();
template <>
hid_t MemoryType<float>() {
  return H5Tcopy(H5T_NATIVE_FLOAT);
}
template <>
hid_t MemoryType<double>() {
  return H5Tcopy(H5T_NATIVE_DOUBLE);
}
template <>
hid_t MemoryType<int64_t>() {
  return H5Tcopy(H5T_NATIVE_INT64);
}
template <>
hid_t MemoryType<uint8_t>() {
  return MakeBoolType();
}

// Returns the shape of an array, or nothing if it has more numbers than a file can hold.
std::optional<Hdf5Shape> ShapeOf(hid_t space) {
  constexpr hsize_t kMost = hsize_t{1} << 40;
  const int dimensions = H5Sget_simple_extent_ndims(space);
  if (dimensions < 1) return Hdf5Shape{.rows = 0, .columns = {}};
  std::vector<hsize_t> sizes(dimensions);
  H5Sget_simple_extent_dims(space, sizes.data(), nullptr);
  hsize_t all = 1;
  for (const hsize_t size : sizes) {
    if (size > kMost || __builtin_mul_overflow(all, std::max<hsize_t>(size, 1), &all) ||
        all > kMost) {
      return std::nullopt;
    }
  }
  Hdf5Shape shape = {.rows = static_cast<int64_t>(sizes[0]), .columns = {}};
  for (int i = 1; i < dimensions; ++i) {
    shape.columns = shape.columns.value_or(1) * static_cast<int64_t>(sizes[i]);
  }
  return shape;
}

// Returns true if an attribute has one value. Others would be written behind the variable that
// receives the value.
bool IsSingle(hid_t attribute) {
  const Handle space(H5Aget_space(attribute), H5Sclose);
  return space >= 0 && H5Sget_simple_extent_npoints(space) == 1;
}

// Returns whether the numbers of an array are in the file of this path: a file may link to another
// one, or name any file of the machine as the place of its numbers.
bool IsInFile(hid_t data, const std::string& path) {
  std::string owner(path.size() + 1, '\0');
  const ssize_t length = H5Fget_name(data, owner.data(), owner.size());
  owner.resize(path.size());
  if (length != static_cast<ssize_t>(path.size()) || owner != path) return false;
  const Handle properties(H5Dget_create_plist(data), H5Pclose);
  const H5D_layout_t layout = H5Pget_layout(properties);
  const bool contiguous_or_chunked =
      layout == H5D_COMPACT || layout == H5D_CONTIGUOUS || layout == H5D_CHUNKED;
  return contiguous_or_chunked && H5Pget_external_count(properties) == 0;
}

// Turns off the library's error reports on standard error. Errors are returned as statuses, and the
// reports add nothing to them.
void Silence() { H5Eset_auto2(H5E_DEFAULT, nullptr, nullptr); }

hid_t MakeStringType() {
  const hid_t type = H5Tcopy(H5T_C_S1);
  H5Tset_size(type, H5T_VARIABLE);
  H5Tset_cset(type, H5T_CSET_UTF8);
  return type;
}

}  // namespace

absl::StatusOr<Hdf5File> Hdf5File::Create(const std::string& path) {
  Silence();
  const hid_t id = H5Fcreate(path.c_str(), H5F_ACC_TRUNC, H5P_DEFAULT, H5P_DEFAULT);
  if (id < 0) return absl::UnavailableError(absl::StrCat(path, ": cannot write"));
  return Hdf5File(path, id);
}

absl::StatusOr<Hdf5File> Hdf5File::Open(const std::string& path) {
  Silence();
  const hid_t id = H5Fopen(path.c_str(), H5F_ACC_RDONLY, H5P_DEFAULT);
  if (id < 0) return absl::NotFoundError(absl::StrCat(path, ": cannot read as HDF5"));
  return Hdf5File(path, id);
}

Hdf5File::Hdf5File(Hdf5File&& other) noexcept
    : path_(std::move(other.path_)), id_(std::exchange(other.id_, -1)) {}

Hdf5File::~Hdf5File() {
  if (id_ >= 0) H5Fclose(id_);
}

absl::Status Hdf5File::Close() {
  if (H5Fclose(std::exchange(id_, -1)) >= 0) return absl::OkStatus();
  return absl::UnavailableError(absl::StrCat(path_, ": cannot write"));
}

absl::Status Hdf5File::CreateGroup(const std::string& name) {
  const Handle group(H5Gcreate2(id_, name.c_str(), H5P_DEFAULT, H5P_DEFAULT, H5P_DEFAULT),
                     H5Gclose);
  return group < 0 ? Failed("write", name) : absl::OkStatus();
}

bool Hdf5File::Exists(const std::string& name) const {
  // H5Lexists fails unless every group on the path exists, so each is checked in turn.
  for (size_t end = name.find('/'); end != std::string::npos; end = name.find('/', end + 1)) {
    if (H5Lexists(id_, name.substr(0, end).c_str(), H5P_DEFAULT) <= 0) return false;
  }
  return H5Lexists(id_, name.c_str(), H5P_DEFAULT) > 0;
}

absl::Status Hdf5File::WriteNumber(const std::string& object, const std::string& name, int64_t type,
                                   const void* value) {
  const Handle space(H5Screate(H5S_SCALAR), H5Sclose);
  const Handle attribute(H5Acreate_by_name(id_, object.c_str(), name.c_str(), type, space,
                                           H5P_DEFAULT, H5P_DEFAULT, H5P_DEFAULT),
                         H5Aclose);
  const bool written = attribute >= 0 && H5Awrite(attribute, type, value) >= 0;
  return written ? absl::OkStatus() : Failed("write", absl::StrCat(object, "@", name));
}

absl::Status Hdf5File::WriteAttribute(const std::string& object, const std::string& name,
                                      int64_t value) {
  return WriteNumber(object, name, H5T_NATIVE_INT64, &value);
}

absl::Status Hdf5File::WriteAttribute(const std::string& object, const std::string& name,
                                      double value) {
  return WriteNumber(object, name, H5T_NATIVE_DOUBLE, &value);
}

absl::Status Hdf5File::WriteAttribute(const std::string& object, const std::string& name,
                                      const std::string& value) {
  const Handle type(MakeStringType(), H5Tclose);
  const Handle space(H5Screate(H5S_SCALAR), H5Sclose);
  const Handle attribute(H5Acreate_by_name(id_, object.c_str(), name.c_str(), type, space,
                                           H5P_DEFAULT, H5P_DEFAULT, H5P_DEFAULT),
                         H5Aclose);
  const char* text = value.c_str();
  const bool written = attribute >= 0 && H5Awrite(attribute, type, &text) >= 0;
  return written ? absl::OkStatus() : Failed("write", absl::StrCat(object, "@", name));
}

absl::Status Hdf5File::ReadNumber(const std::string& object, const std::string& name, int64_t type,
                                  void* value) const {
  const Handle attribute(
      H5Aopen_by_name(id_, object.c_str(), name.c_str(), H5P_DEFAULT, H5P_DEFAULT), H5Aclose);
  if (attribute < 0) {
    return absl::NotFoundError(absl::StrCat(path_, ": no attribute ", object, "@", name));
  }
  if (IsSingle(attribute) && H5Aread(attribute, type, value) >= 0) return absl::OkStatus();
  return Failed("read", absl::StrCat(object, "@", name));
}

absl::StatusOr<int64_t> Hdf5File::ReadInteger(const std::string& object,
                                              const std::string& name) const {
  int64_t value = 0;
  RETURN_IF_ERROR(ReadNumber(object, name, H5T_NATIVE_INT64, &value));
  return value;
}

absl::StatusOr<double> Hdf5File::ReadDouble(const std::string& object,
                                            const std::string& name) const {
  double value = 0.0;
  if (auto status = ReadNumber(object, name, H5T_NATIVE_DOUBLE, &value); !status.ok())
    return status;
  return value;
}

absl::StatusOr<std::string> Hdf5File::ReadString(const std::string& object,
                                                 const std::string& name) const {
  const Handle attribute(
      H5Aopen_by_name(id_, object.c_str(), name.c_str(), H5P_DEFAULT, H5P_DEFAULT), H5Aclose);
  if (attribute < 0) {
    return absl::NotFoundError(absl::StrCat(path_, ": no attribute ", object, "@", name));
  }
  const Handle type(MakeStringType(), H5Tclose);
  char* text = nullptr;
  if (!IsSingle(attribute) || H5Aread(attribute, type, &text) < 0 || text == nullptr) {
    return Failed("read", absl::StrCat(object, "@", name));
  }
  std::string value = text;
  H5free_memory(text);
  return value;
}

template <typename T>
absl::Status Hdf5File::Write(const std::string& name, const Hdf5Shape& shape,
                             absl::Span<const T> values) {
  SPIKESERVE_DCHECK_EQ(static_cast<int64_t>(values.size()), shape.size());
  const hsize_t sizes[] = {static_cast<hsize_t>(shape.rows),
                           static_cast<hsize_t>(shape.columns.value_or(0))};
  const Handle space(H5Screate_simple(shape.columns ? 2 : 1, sizes, nullptr), H5Sclose);
  const Handle type(MemoryType<T>(), H5Tclose);
  const Handle data(
      H5Dcreate2(id_, name.c_str(), type, space, H5P_DEFAULT, H5P_DEFAULT, H5P_DEFAULT), H5Dclose);
  const bool written =
      data >= 0 && H5Dwrite(data, type, H5S_ALL, H5S_ALL, H5P_DEFAULT, values.data()) >= 0;
  return written ? absl::OkStatus() : Failed("write", name);
}

absl::StatusOr<int64_t> Hdf5File::OpenArray(const std::string& name) const {
  const hid_t data = H5Dopen2(id_, name.c_str(), H5P_DEFAULT);
  if (data < 0) return absl::NotFoundError(absl::StrCat(path_, ": no array ", name));
  if (IsInFile(data, path_)) return data;
  H5Dclose(data);
  return absl::InvalidArgumentError(absl::StrCat(
      path_, ": ", name, ": expected numbers in this file, received those of another one"));
}

template <typename T>
absl::StatusOr<Hdf5Array<T>> Hdf5File::Read(const std::string& name) const {
  ASSIGN_OR_RETURN(const hid_t opened, OpenArray(name));
  const Handle data(opened, H5Dclose);
  const Handle space(H5Dget_space(data), H5Sclose);
  const Handle type(MemoryType<T>(), H5Tclose);
  const auto shape = ShapeOf(space);
  if (!shape.has_value()) return Failed("read", name);
  Hdf5Array<T> array = {.shape = *shape, .values = {}};
  array.values.resize(array.shape.size());
  if (H5Dread(data, type, H5S_ALL, H5S_ALL, H5P_DEFAULT, array.values.data()) >= 0) return array;
  return Failed("read", name);
}

absl::StatusOr<std::vector<bool>> Hdf5File::ReadBools(const std::string& name) const {
  ASSIGN_OR_RETURN(const hid_t opened, OpenArray(name));
  const Handle data(opened, H5Dclose);
  const Handle stored(H5Dget_type(data), H5Tclose);
  if (H5Tget_class(stored) != H5T_ENUM) {
    ASSIGN_OR_RETURN(const auto integers, Read<int64_t>(name));
    return std::vector<bool>(integers.values.begin(), integers.values.end());
  }
  ASSIGN_OR_RETURN(const auto bytes, Read<uint8_t>(name));
  return std::vector<bool>(bytes.values.begin(), bytes.values.end());
}

absl::Status Hdf5File::Failed(absl::string_view action, const std::string& name) const {
  return absl::InvalidArgumentError(absl::StrCat(path_, ": cannot ", action, " ", name));
}

template absl::Status Hdf5File::Write(const std::string&, const Hdf5Shape&,
                                      absl::Span<const float>);
template absl::Status Hdf5File::Write(const std::string&, const Hdf5Shape&,
                                      absl::Span<const double>);
template absl::Status Hdf5File::Write(const std::string&, const Hdf5Shape&,
                                      absl::Span<const int64_t>);
template absl::Status Hdf5File::Write(const std::string&, const Hdf5Shape&,
                                      absl::Span<const uint8_t>);
template absl::StatusOr<Hdf5Array<float>> Hdf5File::Read(const std::string&) const;
template absl::StatusOr<Hdf5Array<double>> Hdf5File::Read(const std::string&) const;
template absl::StatusOr<Hdf5Array<int64_t>> Hdf5File::Read(const std::string&) const;

}  // namespace spikeserve
