// A counter-based generator: the draw for a key is a pure function of the key, so that nothing
// depends on how many draws came before, on threads, or on whether a token is computed again.
#ifndef CORE_MATH_COUNTER_RANDOM_H_
#define CORE_MATH_COUNTER_RANDOM_H_

#include <cstdint>
#include <initializer_list>

namespace spikeserve {

// SplitMix64's finaliser (Steele, Lea & Flood, "Fast splittable pseudorandom number generators",
// OOPSLA 2014).
constexpr uint64_t MixBits(uint64_t x) {
  x += 0x9e3779b97f4a7c15ull;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ull;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebull;
  return x ^ (x >> 31);
}

// 64 random bits for a key of any length; the order of its parts matters.
constexpr uint64_t RandomBits(std::initializer_list<uint64_t> key) {
  uint64_t state = 0;
  for (const uint64_t part : key) state = MixBits(state ^ MixBits(part));
  return state;
}

// Uniform in [0, 1) with 24 bits, exact in float32.
constexpr float UniformFloat(uint64_t bits) { return static_cast<float>(bits >> 40) * 0x1p-24f; }

// Uniform in [0, 1) with 53 bits.
constexpr double UniformDouble(uint64_t bits) { return static_cast<double>(bits >> 11) * 0x1p-53; }

}  // namespace spikeserve

#endif  // CORE_MATH_COUNTER_RANDOM_H_
