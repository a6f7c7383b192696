// Contiguous arrays seen as Eigen's vectors and matrices, without a copy.
//
// `values` is a std::vector, an absl::Span, an Eigen vector or anything else with data() and
// size(). A view is writable if `values` is, and valid as long as the memory of `values`. Free
// functions, safe to call from many threads.
#pragma once

#include <type_traits>

#include "Eigen/Core"
#include "core/contract/dcheck.h"

namespace spikeserve {

template <typename T>
using RowMajorMatrix = Eigen::Matrix<T, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

// Returns all of `values` as one column vector.
template <typename Values>
auto AsVector(Values&& values) {
  using Vector = Eigen::VectorX<std::remove_cvref_t<decltype(*values.data())>>;
  return Vector::Map(values.data(), static_cast<Eigen::Index>(values.size()));
}

// Returns all of `values` as a row-major matrix of `rows` rows. REQUIRES: `rows` divides the size,
// and is at least 1.
template <typename Values>
auto AsMatrix(Values&& values, Eigen::Index rows) {
  SPIKESERVE_DCHECK_GE(rows, 1);
  SPIKESERVE_DCHECK_EQ(static_cast<Eigen::Index>(values.size()) % rows, 0);
  using Matrix = RowMajorMatrix<std::remove_cvref_t<decltype(*values.data())>>;
  return Matrix::Map(values.data(), rows, static_cast<Eigen::Index>(values.size()) / rows);
}

}  // namespace spikeserve
