// Defines the roundings of integer arithmetic (docs/design/integer.md).
//
// All functions are pure and thread-safe.
#pragma once

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdint>

namespace spikeserve {

// Returns value / 2^shift, rounded to the nearest integer, halves upwards; value * 2^-shift if
// `shift` is negative.
constexpr int64_t RoundShift(int64_t value, int shift) {
  if (shift <= 0) return value * (int64_t{1} << -shift);
  return (value + (int64_t{1} << (shift - 1))) >> shift;
}

// Returns numerator / denominator, rounded to the nearest integer, halves upwards. REQUIRES:
// denominator > 0, and |2 numerator + denominator| < 2^63.
constexpr int64_t RoundDivide(int64_t numerator, int64_t denominator) {
  const int64_t dividend = 2 * numerator + denominator;
  const int64_t divisor = 2 * denominator;
  const int64_t quotient = dividend / divisor;
  return quotient - (dividend % divisor < 0 ? 1 : 0);  // C++ rounds towards zero
}

// Returns the number of [-32767, 32767] that is nearest to `value`. -32768 is excluded, so that the
// sign of the result may be changed.
constexpr int32_t SaturateResidual(int64_t value) {
  return static_cast<int32_t>(std::clamp<int64_t>(value, -32767, 32767));
}

// Returns the largest integer whose square is at most `value`. IEEE 754 rounds the root in double
// correctly, and no root of a number below 2^32 is so close to the next integer that it rounds up.
inline uint32_t SquareRoot(uint32_t value) {
  return static_cast<uint32_t>(std::sqrt(static_cast<double>(value)));
}

// Factors by which an integer norm divides by the root of a sum of squares.
struct InverseRoot {
  int shift = 0;        // of a centred number, before it is multiplied
  int32_t inverse = 0;  // (2^14, 2^15], or 0 if the sum is 0

  // Returns centred / sqrt(sum of squares) with 15 fraction bits.
  int32_t Normalise(int32_t centred) const {
    return static_cast<int32_t>(RoundShift(RoundShift(centred, shift) * inverse, 15));
  }
};

// Returns the factors for a sum of squares.
inline InverseRoot InverseRootOf(uint64_t squares) {
  if (squares == 0) return {};
  const int shift = (static_cast<int>(std::bit_width(squares)) - 31) >> 1;
  const uint64_t scaled = shift > 0 ? squares >> (2 * shift) : squares << (-2 * shift);
  return {shift, static_cast<int32_t>((1u << 30) / SquareRoot(static_cast<uint32_t>(scaled)))};
}

// Returns 2^(16 - octaves / 256), interpolated linearly between whole octaves and rounded down, and
// 0 from 16 octaves on. REQUIRES: octaves >= 0.
constexpr int32_t PowerOfTwo(int64_t octaves) {
  const int64_t whole = octaves >> 8;
  const auto part = static_cast<int32_t>(octaves & 255);
  return whole > 15 ? 0 : (65536 - (part << 7)) >> whole;
}

}  // namespace spikeserve
