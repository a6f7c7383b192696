#include "core/engine/spiking/kernels/sdot_kernel.h"

#include <arm_neon.h>

#include <cstring>

namespace spikeserve::kernels {
namespace {

constexpr int kRowLanes = 8;  // lanes of a pair's weights in one vector

// Returns the two counts of a pair.
inline int32_t Counts(const int16_t* counts, int32_t pair) {
  int32_t both;
  std::memcpy(&both, counts + 2 * static_cast<ptrdiff_t>(pair), sizeof(both));
  return both;
}

// Returns the counts of two pairs as 8-bit numbers, four times.
inline int8x16_t NarrowCounts(int32_t first, int32_t second) {
  const int32x4_t both = vsetq_lane_s32(second, vdupq_n_s32(first), 1);
  const int8x8_t narrow = vmovn_s16(vreinterpretq_s16_s32(both));
  return vreinterpretq_s8_s32(vdupq_lane_s32(vreinterpret_s32_s8(narrow), 0));
}

// Returns `address`, but hides its origin from the compiler; see simd-inl.h.
inline const int8_t* Opaque(const int8_t* address) {
  asm("" : "+r"(address));
  return address;
}

// Adds the products of two pairs, whose rows begin at the block's first lane.
template <int kVectors>
inline void AddPairs(const int8_t* first, const int8_t* second, int8x16_t counts,
                     int32x4_t (&total)[2 * kVectors]) {
  first = Opaque(first);
  second = Opaque(second);
  for (int v = 0; v < kVectors; ++v) {
    const int16x8_t x = vreinterpretq_s16_s8(vld1q_s8(first + v * 2 * kRowLanes));
    const int16x8_t y = vreinterpretq_s16_s8(vld1q_s8(second + v * 2 * kRowLanes));
    // Each 32 bits have one lane's weights for the four counts.
    const int8x16_t low = vreinterpretq_s8_s16(vzip1q_s16(x, y));
    const int8x16_t high = vreinterpretq_s8_s16(vzip2q_s16(x, y));
    total[2 * v] = vdotq_s32(total[2 * v], low, counts);
    total[2 * v + 1] = vdotq_s32(total[2 * v + 1], high, counts);
  }
}

// Computes kVectors * kRowLanes lanes, from `lane` on.
template <int kVectors>
void Block(const SdotMap& map, const int16_t* counts, const int32_t* pairs, size_t size, int lane,
           float* update) {
  const auto row = [&](int32_t pair) {
    return map.rows + (static_cast<size_t>(pair) * map.width + lane) * 2;
  };
  int32x4_t total[2 * kVectors];
  for (int32x4_t& each : total) each = vdupq_n_s32(0);
  size_t i = 0;
  for (; i + 2 <= size; i += 2) {
    const int8x16_t both = NarrowCounts(Counts(counts, pairs[i]), Counts(counts, pairs[i + 1]));
    AddPairs<kVectors>(row(pairs[i]), row(pairs[i + 1]), both, total);
  }
  if (i < size) {
    const int8x16_t one = NarrowCounts(Counts(counts, pairs[i]), 0);
    AddPairs<kVectors>(row(pairs[i]), row(pairs[i]), one, total);
  }
  for (int v = 0; v < 2 * kVectors; ++v) {
    const int k = lane + v * kRowLanes / 2;
    const float32x4_t scaled = vmulq_f32(vld1q_f32(map.factor + k), vcvtq_f32_s32(total[v]));
    vst1q_f32(update + k, vaddq_f32(scaled, vld1q_f32(map.bias + k)));
  }
}

}  // namespace

void AffineBySdot(const SdotMap& map, const int16_t* counts, const int32_t* pairs, size_t size,
                  float* update) {
  constexpr int kVectors = 8;  // 16 registers of sums, as many for the rest
  int lane = 0;
  for (; lane + kVectors * kRowLanes <= map.width; lane += kVectors * kRowLanes) {
    Block<kVectors>(map, counts, pairs, size, lane, update);
  }
  if (lane < map.width) Block<kVectors / 2>(map, counts, pairs, size, lane, update);
}

}  // namespace spikeserve::kernels
