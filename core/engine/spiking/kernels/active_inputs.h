// Memory in which a linear map lists its inputs that are not zero.
//
// The caller keeps it between calls: a thread-local variable of the kernels would cost a function
// call at every access in a shared library.
#pragma once

#include <cstdint>
#include <vector>

namespace spikeserve::kernels {

// Indices of inputs, or of pairs of inputs, ascending.
using ActiveInputs = std::vector<int32_t>;

}  // namespace spikeserve::kernels
