// The Frobenius norm of weights, equal bit for bit on every machine.
//
// A free function, safe to call from many threads.
#pragma once

#include <cmath>

#include "Eigen/Core"

namespace spikeserve {

// Returns sqrt(sum_i v_i^2), added in double precision in the order of the elements. Eigen's
// norm() adds in an order that depends on the SIMD width, and a replayed session needs equal bits.
template <typename Vector>
double FrobeniusNorm(const Eigen::MatrixBase<Vector>& vector) {
  double squares = 0.0;
  for (Eigen::Index i = 0; i < vector.size(); ++i) {
    const auto value = static_cast<double>(vector.coeff(i));
    squares += value * value;
  }
  return std::sqrt(squares);
}

}  // namespace spikeserve
