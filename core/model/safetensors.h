// Reads and writes the safetensors container: named float32 tensors and string metadata in one
// file.
//
// Layout: N, an unsigned 64-bit little-endian integer; N bytes of UTF-8 JSON that begin with `{`
// and may end in spaces; then the tensors' data, row-major, packed and little-endian. The JSON maps
// each tensor's name to `dtype`, `shape` and `data_offsets` [begin, end), counted from byte 8 + N,
// and `__metadata__` to a map from strings to strings.
//
// All functions are thread-safe.
#ifndef CORE_MODEL_SAFETENSORS_H_
#define CORE_MODEL_SAFETENSORS_H_

#include <cstdint>
#include <map>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/model/weights.h"

namespace spikeserve {

inline constexpr uint64_t kMaxSafetensorsHeaderBytes = 100'000'000;
// 2^30 float32 values, so that every count of values fits in an int.
inline constexpr uint64_t kMaxSafetensorsFileBytes = uint64_t{1} << 32;

struct Safetensors {
  std::map<std::string, std::string> metadata;
  std::map<std::string, Tensor> tensors;
};

// Reads a container in which every tensor is F32. Compares every size in the file with the size of
// the file before it is used, and requires that every data byte belongs to exactly one tensor.
// NOT_FOUND if there is no such file, INVALID_ARGUMENT if the format is violated; the message names
// the tensor or field, but not the path.
absl::StatusOr<Safetensors> ReadSafetensors(const std::string& path);

// Writes the layout of the reference implementation: tensors sorted by name (all have the same
// dtype), and the header padded with spaces to a multiple of 8 bytes. Replaces `path` atomically
// (see file.h). REQUIRES: the number of values of every tensor matches its shape.
absl::Status WriteSafetensors(const Safetensors& contents, const std::string& path);

}  // namespace spikeserve

#endif  // CORE_MODEL_SAFETENSORS_H_
