// Shares the rows of packed maps between processes, and restores maps from packed ones.
//
// All functions are thread-safe on distinct objects.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>
#include <type_traits>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/shared_bytes.h"
#include "core/engine/spiking/packed/aligned_vector.h"
#include "core/math/tensor.h"

namespace spikeserve {

inline size_t NextCacheLine(size_t offset) {
  const auto line = static_cast<size_t>(kCacheLine);
  return (offset + line - 1) / line * line;
}

// Moves rows to memory that the processes of this user share. `visit_rows(visitor)` calls the
// visitor with every ConstantArray, in a fixed order. Errors: see ShareBytes (shared_bytes.h).
template <class VisitRows>
absl::Status ShareRows(const std::string& folder, const VisitRows& visit_rows) {
  std::string bytes;
  visit_rows([&](auto& rows) {
    bytes.resize(NextCacheLine(bytes.size()));
    bytes.append(reinterpret_cast<const char*>(rows.data()), rows.bytes());
  });
  const absl::StatusOr<std::shared_ptr<const char>> shared = ShareBytes(folder, bytes);
  if (!shared.ok()) return shared.status();
  size_t offset = 0;
  visit_rows([&](auto& rows) {
    offset = NextCacheLine(offset);
    rows.MoveTo({*shared, reinterpret_cast<decltype(rows.data())>(shared->get() + offset)});
    offset += rows.bytes();
  });
  return absl::OkStatus();
}

// Frees the memory, which clear() would keep.
template <class Number>
void Free(BasicTensor<Number>* tensor) {
  tensor->values = std::vector<Number>();
}

// Copies the weights of one map, whose outputs are the lanes of `packed` from `lane` on.
template <class Packed, class Weight>
void UnpackWeights(const Packed& packed, int lane, Weight* weight) {
  const int outputs = weight->shape[0];
  const int inputs = weight->shape[1];
  *weight = std::decay_t<Weight>::Zeros(weight->shape);
  for (int k = 0; k < outputs; ++k) {
    for (int j = 0; j < inputs; ++j) {
      weight->values[static_cast<size_t>(k) * inputs + j] = packed.weight(j, lane + k);
    }
  }
}

}  // namespace spikeserve
