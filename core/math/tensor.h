// Defines row-major float32 arrays, and the affine maps that they are the parameters of.
//
// Plain values; const members are thread-safe.
#ifndef CORE_MATH_TENSOR_H_
#define CORE_MATH_TENSOR_H_

#include <cstddef>
#include <vector>

namespace spikeserve {

// Stores a row-major array. The shape of a vector is {length}; the shape of a matrix is {out, in}.
struct Tensor {
  std::vector<int> shape;
  std::vector<float> values;

  // Returns a tensor of `shape` filled with zeros.
  static Tensor Zeros(std::vector<int> shape);
  // Returns one element of a matrix. REQUIRES: two dimensions, and indices within them.
  float at(int row, int column) const {
    return values[static_cast<size_t>(row) * shape[1] + column];
  }
};

// The affine map y = weight x + bias.
struct Linear {
  Tensor weight;  // [out, in]
  Tensor bias;    // [out]
};

}  // namespace spikeserve

#endif  // CORE_MATH_TENSOR_H_
