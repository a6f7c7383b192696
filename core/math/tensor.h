// Defines row-major arrays of numbers, and the affine maps that they are the parameters of.
//
// Plain values; const members are thread-safe.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "core/contract/dcheck.h"

namespace spikeserve {

// Stores a row-major array. The shape of a vector is {length}; the shape of a matrix is {out, in}.
template <class Number>
struct BasicTensor {
  std::vector<int> shape;
  std::vector<Number> values;

  // Returns a tensor of `shape` filled with zeros.
  static BasicTensor Zeros(const std::vector<int>& shape) {
    size_t size = 1;
    for (const int length : shape) size *= static_cast<size_t>(length);
    return {.shape = shape, .values = std::vector<Number>(size)};
  }
  // Returns one element of a matrix. REQUIRES: two dimensions, and indices within them.
  Number at(int row, int column) const {
    SPIKESERVE_DCHECK_EQ(shape.size(), size_t{2});
    SPIKESERVE_DCHECK(row >= 0 && row < shape[0]);
    SPIKESERVE_DCHECK(column >= 0 && column < shape[1]);
    return values[static_cast<size_t>(row) * shape[1] + column];
  }
};

using Tensor = BasicTensor<float>;
using Int8Tensor = BasicTensor<int8_t>;
using Int16Tensor = BasicTensor<int16_t>;

// The affine map y = weight x + bias.
struct Linear {
  Tensor weight;  // [out, in]
  Tensor bias;    // [out]
};

}  // namespace spikeserve
