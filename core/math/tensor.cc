#include "core/math/tensor.h"

#include <utility>

namespace spikeserve {

Tensor Tensor::Zeros(std::vector<int> shape) {
  size_t size = 1;
  for (const int length : shape) size *= static_cast<size_t>(length);
  return {.shape = std::move(shape), .values = std::vector<float>(size)};
}

}  // namespace spikeserve
