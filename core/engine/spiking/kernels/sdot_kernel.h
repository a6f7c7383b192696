// The part of Affine (integer_kernels.h) that multiplies, with the arm64 instruction SDOT, which
// has 16 products of 8 bits where NEON's others have 4 of 16 bits.
//
// It has no place among Highway's targets, because Highway 1.0 has none between NEON and SVE.
// sdot_kernel.cc is compiled for processors with SDOT, so it must contain nothing that others run.
#ifndef CORE_ENGINE_SPIKING_KERNELS_SDOT_KERNEL_H_
#define CORE_ENGINE_SPIKING_KERNELS_SDOT_KERNEL_H_

#include <cstddef>
#include <cstdint>

namespace spikeserve::kernels {

// A PackedIntegerOutput as plain pointers.
struct SdotMap {
  const int8_t* rows;   // [inputs / 2][width][2]
  const float* factor;  // [width]
  const float* bias;    // [width]
  int width;            // a multiple of 32
};

// Sets update[lane] = factor * float(sum of count * weight over the inputs of `pairs` [size]) +
// bias for all lanes. Thread-safe on distinct arrays. REQUIRES: UsesSdot(); counts at most
// 127.
void AffineBySdot(const SdotMap& map, const int16_t* counts, const int32_t* pairs, size_t size,
                  float* update);

}  // namespace spikeserve::kernels

#endif  // CORE_ENGINE_SPIKING_KERNELS_SDOT_KERNEL_H_
