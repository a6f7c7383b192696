// Arrays of float32 in row-major order, and the affine map that two of them make.
//
// Plain values; const members are safe to call from many threads.
#ifndef CORE_MATH_TENSOR_H_
#define CORE_MATH_TENSOR_H_

#include <cstddef>
#include <vector>

namespace spikeserve {

// A row-major array. A vector has one row length and shape {n}; a matrix has shape {out, in}.
struct Tensor {
  std::vector<int> shape;
  std::vector<float> values;

  static Tensor Zeros(std::vector<int> shape);
  float at(int row, int column) const {
    return values[static_cast<size_t>(row) * shape[1] + column];
  }
};

struct Linear {
  Tensor weight;  // [out, in]
  Tensor bias;    // [out]
};

}  // namespace spikeserve

#endif  // CORE_MATH_TENSOR_H_
