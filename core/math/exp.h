// Computes the exponential with equal bits in every engine, on every processor and at every SIMD
// width.
//
// The C library's expf differs in its last bit between versions and processors, and that bit can
// decide whether a neuron fires. The functions below use only float32 arithmetic in a fixed order.
// All are pure and thread-safe.
#pragma once

#include <bit>
#include <cstdint>

namespace spikeserve {

// Returns e^x to within 2 units in the last place. Clamps x to [-87, 88], so the result is finite
// and positive; returns NaN if x is NaN. Reduces the range by powers of two, then evaluates the
// polynomial of Cephes' expf (S. L. Moshier, Methods and Programs for Mathematical Functions,
// 1989).
inline float Exp(float x) {
  x = x < -87.0f ? -87.0f : x;
  x = x > 88.0f ? 88.0f : x;
  constexpr float kRoundToInteger = 12582912.0f;  // 1.5 * 2^23: adding it rounds to an integer
  const float rounded = x * 1.44269504088896341f + kRoundToInteger;
  const float n = rounded - kRoundToInteger;
  x = x - n * 0.693359375f;
  x = x - n * -2.12194440e-4f;
  float y = 1.9875691500e-4f;
  y = y * x + 1.3981999507e-3f;
  y = y * x + 8.3334519073e-3f;
  y = y * x + 4.1665795894e-2f;
  y = y * x + 1.6666665459e-1f;
  y = y * x + 5.0000001201e-1f;
  y = y * (x * x) + x + 1.0f;
  // The low bits of `rounded` count from kRoundToInteger. A cast of n would be undefined for NaN.
  const uint32_t power =
      std::bit_cast<uint32_t>(rounded) - std::bit_cast<uint32_t>(kRoundToInteger);
  return y * std::bit_cast<float>((power + 127) << 23);
}

inline float Sigmoid(float x) { return 1.0f / (1.0f + Exp(-x)); }

inline float Tanh(float x) { return 1.0f - 2.0f / (Exp(2.0f * x) + 1.0f); }

}  // namespace spikeserve
