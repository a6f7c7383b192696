// Reads and writes the safetensors container: named tensors of float32, int8 or int16 numbers and
// string metadata in one file.
//
// Layout: N, an unsigned 64-bit little-endian integer; N bytes of UTF-8 JSON that begin with `{`
// and may end in spaces; then the tensors' data, row-major, packed and little-endian. The JSON maps
// each tensor's name to `dtype`, `shape` and `data_offsets` [begin, end), counted from byte 8 + N,
// and `__metadata__` to a map from strings to strings.
//
// All functions are thread-safe.
#pragma once

#include <cstdint>
#include <map>
#include <string>
#include <variant>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "core/model/weights.h"

namespace spikeserve {

inline constexpr uint64_t kMaxSafetensorsHeaderBytes = 100'000'000;
// Room for 2^30 float32 values.
inline constexpr uint64_t kMaxSafetensorsFileBytes = uint64_t{1} << 32;

// A tensor of dtype F32, I8 or I16.
using AnyTensor = std::variant<Tensor, Int8Tensor, Int16Tensor>;

// Returns the name of a tensor's dtype in the file: "F32", "I8" or "I16".
std::string DtypeName(const AnyTensor& tensor);

struct Safetensors {
  std::map<std::string, std::string> metadata;
  std::map<std::string, AnyTensor> tensors;
};

// Returns the bytes of a file, unless its size is out of range. NOT_FOUND if there is no such file,
// INVALID_ARGUMENT if it is not a regular file, or too long; the message does not name the path.
absl::StatusOr<std::string> ReadSafetensorsFile(const std::string& path);

// Parses a container in which every tensor is F32, I8 or I16. Compares every size in the bytes with
// the number of bytes before it is used, and requires that every data byte belongs to exactly one
// tensor. INVALID_ARGUMENT if the format is violated; the message names the tensor or field.
absl::StatusOr<Safetensors> ParseSafetensors(absl::string_view bytes);

// Does both.
absl::StatusOr<Safetensors> ReadSafetensors(const std::string& path);

// Returns the bytes of a container in the layout of the reference implementation: tensors sorted by
// dtype (widest first), then by name, and the header padded with spaces to a multiple of 8 bytes.
// REQUIRES: the number of values of every tensor matches its shape.
absl::StatusOr<std::string> FormatSafetensors(const Safetensors& contents);

// Writes the bytes of FormatSafetensors(). Replaces `path` atomically (see file.h).
absl::Status WriteSafetensors(const Safetensors& contents, const std::string& path);

}  // namespace spikeserve
