// The safetensors container: named float32 tensors and string metadata in one file.
//
// Layout: N, an unsigned 64-bit little-endian integer; N bytes of UTF-8 JSON that begin with `{`
// and may end in spaces; then the tensors' data, row-major, packed and little-endian. The JSON maps
// each tensor's name to `dtype`, `shape` and `data_offsets` [begin, end), counted from byte 8 + N,
// and
// `__metadata__` to strings.
//
// Free functions without shared state; safe to call from many threads.
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
// 2^30 values, so that counting them never leaves an int.
inline constexpr uint64_t kMaxSafetensorsFileBytes = uint64_t{1} << 32;

struct Safetensors {
  std::map<std::string, std::string> metadata;
  std::map<std::string, Tensor> tensors;
};

// Reads a container whose every tensor is F32. No size in the file is believed before it was held
// against the file's own size, and no byte may belong to two tensors or to none. NOT_FOUND if there
// is no such file, INVALID_ARGUMENT on anything that breaks the format; the message names the
// tensor or field, but not the path.
absl::StatusOr<Safetensors> ReadSafetensors(const std::string& path);

// Writes the layout of the reference implementation: tensors by name (they share one dtype), the
// header padded with spaces to a multiple of 8. Replaces `path` in one step (see atomic_file.h).
// REQUIRES: every tensor holds as many values as its shape says.
absl::Status WriteSafetensors(const Safetensors& contents, const std::string& path);

}  // namespace spikeserve

#endif  // CORE_MODEL_SAFETENSORS_H_
